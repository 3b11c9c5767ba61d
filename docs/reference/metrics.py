"""Metrics of metrics.json, from the folds that compute them, and the arrays of trajectory.npz."""

from typing import Any

from ambjax.simulation.folds import Count, Driven, Peak, Reaching, Rms, Variation
from ambjax.simulation.metrics import UNITS, Standard
from ambjax.simulation.trajectory import NOT_SAVED, Row
from reference.fields import attribute_docs
from reference.markdown import code, escaped, table

# How a fold makes one number of a signal.
FOLDS = {
    Peak: "largest size",
    Rms: "root mean square over the samples",
    Reaching: "start of the sample in which it first comes within its band",
    Variation: "total variation",
    Count: "number of samples for which it holds",
    Driven: "mean over time, while the drive is on",
}
MEANINGS = {
    "e_z": "tracking error z - r",
    "e": "current tracking error i - i_ref",
    "u_squared": "voltage u",
    "heat": "copper loss in both coils",
    "u_mean": "voltage u, averaged over each sample",
}
# What is not a fold of a signal.
OTHERS = {
    "force_used": "largest magnetic force as a share of that at z = 0 with |i| = i_0 or `actuator.i_max`; the rest is "
    "the reserve",
    "lost": "whether the rotor was lost: touched down, or left the range in which the model is valid",
    "stalled": "whether the integrator could not meet its tolerance, so that nothing is decided",
    "lost_at_s": "when either happened; null: never",
    "singular_at_s": "when (z, i_ref) first crossed the singular curve C, Eq. (9); null: never",
    "lost_why": "why it ended, in words; empty if it did not",
    "method": "the integrator and its step",
    "settle_s": 'when "settled" begins: `run.settle`',
    "trajectory_deviation": "with --member: largest relative difference between the ensemble's metrics and those of "
    "trajectory.npz",
}
SHARE = {
    "clearance_used": "z as a share of the clearance",
    "settled_clearance_used": "z as a share of the clearance",
}


def pages() -> dict[str, str]:
    """Return the page."""
    lines = ["# Metrics and arrays", "", "## `metrics.json`", ""]
    lines += ["Written by `ambjax simulate`; of each member by `ambjax ensemble`.", ""]
    lines += [
        "Errors count every sample, a lost rotor's too, frozen where it was lost. Under held noise u, i, e and "
        "v_tilde jump at the samples: so extremes are taken over the integrator's substeps, and voltage and heat over "
        "time.",
        "",
    ]
    lines += table(("metric", "unit", "meaning"), rows(), "keys")
    lines += ["## `trajectory.npz`", "", "One number per recorded sample in each array, float64, SI units.", ""]
    lines += table(("array", "meaning"), [(code(k), escaped(v)) for k, v in arrays().items()], "keys")
    return {"metrics.md": "\n".join(lines)}


def rows() -> list[tuple[str, str, str]]:
    """Return a row for each metric: name, unit and meaning."""
    folds = Standard()._folds().folds
    meanings = {name: _meaning(name, fold) for name, fold in folds.items()} | OTHERS
    return [(code(name), escaped(UNITS.get(name, "")), escaped(meaning)) for name, meaning in meanings.items()]


def _meaning(name: str, fold: Any) -> str:
    of = getattr(fold, "of", "u_mean")
    signal = SHARE.get(name) or MEANINGS.get(of) or attribute_docs(Row)[of].rpartition(", ")[0]
    how = f"root of the {FOLDS[type(fold)]}, of the square" if getattr(fold, "root", False) else FOLDS[type(fold)]
    how += ", while the drive is on" * getattr(fold, "driven", False)
    return f"{how}: {signal}{', from `run.settle` on' if getattr(fold, 'after', 0.0) else ''}"


def arrays() -> dict[str, str]:
    """Return the meaning of each array of trajectory.npz."""
    told = {name: text for name, text in attribute_docs(Row).items() if name not in NOT_SAVED}
    status = {
        "lost_at": "when the rotor was lost, s; inf: never. One number",
        "lost_why": "why, in words; empty if it was not",
        "singular_at": "when (z, i_ref) first crossed C, s; inf: never. One number",
    }
    return told | status
