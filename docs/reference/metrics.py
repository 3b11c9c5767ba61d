"""Metrics of metrics.json, from the folds that compute them, and the arrays of trajectory.npz."""

from typing import Any

from ambjax.simulation import response
from ambjax.simulation.folds import Count, Driven, Peak, Reaching, Rms, Variation
from ambjax.simulation.metrics import UNITS, Metrics
from ambjax.simulation.trajectory import NOT_SAVED, Row
from reference.fields import attribute_docs
from reference.markdown import code, escaped, table

# The number that a fold computes from a signal.
FOLDS = {
    Peak: "largest absolute value",
    Rms: "root mean square over the samples",
    Reaching: "start of the first sample in which the signal is within its band",
    Variation: "total variation",
    Count: "number of samples",
    Driven: "mean over time, while the drive is on",
}
MEANINGS = {
    "e_z": "tracking error z - r",
    "e": "current tracking error i - i_ref",
    "u_squared": "voltage u",
    "heat": "copper loss in both coils",
    "u_mean": "voltage u, averaged over each sample",
    "u_peak": "voltage at the coils, also between samples",
    "refused": "reading refused by the guard",
}
# Metrics that are not folds of a signal.
OTHERS = {
    "force_used": "largest magnetic force, divided by the largest that the magnets can exert at z = 0 (with |i| = i_0 "
    "or its limit by `actuator.i_max` or `actuator.coil.i_max`)",
    "lost": "whether the rotor was lost: it touched down, or a state left the range in which the model is valid",
    "stalled": "whether the integrator stalled, so that it is not known whether the rotor is held",
    "lost_at_s": "time at which the rotor was lost or the integrator stalled; null: never",
    "singular_at_s": "time at which (z, i_ref) first crossed the singular curve C, Eq. (9); null: never",
    "lost_why": "reason why the run ended early, in words; empty if it did not",
    "method": "the integrator and its step",
    "settle_s": "start of the evaluation of the settled metrics: `run.settle`",
    "trajectory_deviation": "with --member: largest relative difference between the ensemble's metrics and those of "
    "trajectory.npz",
}
# Metrics of a case with [rotor].
for _name in response.UNITS:
    _signal, _order, _kind = _name.split("_")
    OTHERS[_name] = f"with `[rotor]`: {'phase' if _kind == 'deg' else 'amplitude'} of {_signal} at {_order[0]} " + (
        "times the speed, from the fit A cos(k angle + phase) over the whole revolutions from `run.settle` on"
    )
SHARE = {
    "clearance_used": "z as a share of the clearance",
    "settled_clearance_used": "z as a share of the clearance",
}


def pages() -> dict[str, str]:
    """Return the page."""
    lines = ["# Metrics and arrays", "", "## `metrics.json`", ""]
    lines += [
        "`ambjax simulate` writes the metrics of a run, `ambjax ensemble` those of every member (`members.npz`). "
        "Rms errors, forces, flux density, and amplitudes once and twice per revolution are evaluated at the samples. "
        "A lost rotor is frozen, and its error counts until the end. Under held noise, u, i, e and v_tilde jump at the "
        "samples. Their extremes, and those of the errors, are therefore taken over the substeps of the integrator; "
        "voltage and copper loss are averaged over time.",
        "",
    ]
    lines += table(("metric", "unit", "meaning"), rows(), "keys")
    lines += ["## `trajectory.npz`", "", "Each array has one number per sample, float64, in SI units.", ""]
    lines += table(("array", "meaning"), [(code(k), escaped(v)) for k, v in arrays().items()], "keys")
    return {"metrics.md": "\n".join(lines)}


def rows() -> list[tuple[str, str, str]]:
    """Return a row for each metric: name, unit and meaning."""
    folds = Metrics()._folds().folds
    meanings = {name: _meaning(name, fold) for name, fold in folds.items()} | OTHERS
    return [(code(name), escaped(UNITS.get(name, "")), escaped(meaning)) for name, meaning in meanings.items()]


def _meaning(name: str, fold: Any) -> str:
    of = getattr(fold, "of", "u_mean")
    signal = SHARE.get(name) or MEANINGS.get(of) or attribute_docs(Row)[of].rpartition(", ")[0]
    how = "root mean square over time, while the drive is on" if getattr(fold, "root", False) else FOLDS[type(fold)]
    how += ", while the drive is on" * getattr(fold, "driven", False)
    return f"{signal}: {how}{', from `run.settle` on' if getattr(fold, 'after', 0.0) else ''}"


def arrays() -> dict[str, str]:
    """Return the meaning of each array of trajectory.npz."""
    signals = {name: text for name, text in attribute_docs(Row).items() if name not in NOT_SAVED}
    status = {
        "lost_at": "one number: time at which the rotor was lost, s; inf: never",
        "lost_why": "one text: the reason; empty if the rotor was not lost",
        "singular_at": "one number: time at which (z, i_ref) first crossed C, s; inf: never",
    }
    return signals | status
