"""The report of a comparison: its summary, the table on the terminal, and the page."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.machine_case import AnyCase
from ambjax.cases.reader import Case
from ambjax.commands.comparison_loop import ComparedLoop, laws_of
from ambjax.ensemble.study import AnyStudy
from ambjax.linear import Findings
from ambjax.results.operating import MEMBERS
from ambjax.results.outputs import table
from ambjax.simulation import response
from ambjax.text import web_page
from ambjax.text.words import markdown_table, number


@dataclasses.dataclass(frozen=True)
class Compared:
    """A case and its results.

    `columns`: metrics of the members by name, [N] each. `loop`: the linearised loops. `flops`: operations of a step of
    the controller; None without a processor, for a machine, or if a law cannot be exported. `findings`: the stability
    of the members with the largest settled errors.
    """

    case: AnyCase
    columns: Mapping[str, np.ndarray]
    loop: ComparedLoop
    flops: int | None
    findings: Findings = Findings(0, 0)

    @property
    def held(self) -> np.ndarray:
        """Whether each member is held to the end of the run [N]."""
        return ~np.isfinite(self.columns["lost_at"])

    def of(self, name: str, reduce: Callable[[np.ndarray], Any]) -> float | None:
        """Return a metric reduced over the members that are held; None without them."""
        values = np.asarray(self.columns.get(name, ()))
        return float(reduce(values[self.held])) if values.size and self.held.any() else None


class Quantity(NamedTuple):
    """A row of the table, and a number of each case by its key in the summary.

    `less`: whether less is better; None: neither. `metric`, `reduce`: metric of the members, and how it is reduced; "":
    the number has another source. `axis`: name of an axis of a machine; "" for the whole case.
    """

    key: str
    words: str
    unit: str
    less: bool | None = True
    metric: str = ""
    reduce: Callable[[np.ndarray], Any] = np.max
    axis: str = ""

    def value(self, case: Mapping[str, Any]) -> Any:
        """Return the number of a case of the summary; None if it has none."""
        return (case.get("axes", {}).get(self.axis, {}) if self.axis else case).get(self.key)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _mean_phase(degrees: np.ndarray) -> float:
    return float(np.degrees(np.angle(np.mean(np.exp(1j * np.radians(degrees))))))


def _of_order(name: str, unit: str) -> Quantity:
    of = name.rpartition("_")[0].replace("_", " at ")
    if unit == "deg":
        return Quantity(name, f"mean phase of {of}", unit, None, name, _mean_phase)
    return Quantity(name, f"median amplitude of {of}", unit, True, name, np.median)


QUANTITIES = (
    Quantity("lost", "members lost", "1"),
    Quantity("stalled", "members not decided (the integrator stalled)", "1"),
    Quantity("not_stable", "members held, but not stable, of those tested", "1"),
    Quantity("cycle_m", "the largest amplitude of their own oscillation", "m"),
    Quantity("rms_error_median_m", "settled rms error, median", "m", True, "settled_rms_error_m", np.median),
    Quantity("rms_error_worst_m", "settled rms error, worst member", "m", True, "settled_rms_error_m"),
    Quantity("max_error_m", "largest settled error", "m", True, "settled_max_abs_error_m"),
    Quantity("better_than_first", "members with a lower rms error than in the first case", "1", less=False),
    Quantity("rms_u_V", "settled rms voltage, over members", "V", True, "settled_rms_u_V", _rms),
    Quantity("max_u_V", "largest voltage", "V", True, "max_abs_u_V"),
    Quantity("rms_i_A", "rms current, over members", "A", True, "rms_i_A", _rms),
    Quantity("max_i_A", "largest current", "A", True, "max_abs_i_A"),
    Quantity("copper_loss_W", "copper loss, mean", "W", True, "copper_loss_W", np.mean),
    Quantity("chatter_V_per_s", "variation of the voltage, mean", "V/s", True, "chatter_V", np.mean),
    Quantity("clearance_used", "largest settled share of the clearance", "1", True, "settled_clearance_used"),
    Quantity("clearance_zone", "its zone (ISO 14839-2)", "", None),
    Quantity("peak", "peak of |S|", "1"),
    Quantity("frequency_hz", "its frequency", "Hz", None),
    Quantity("zone", "its zone (ISO 14839-3)", "", None),
    Quantity("worst_at", "its axis and speed", "", None),
    Quantity("sigma_max", "largest singular value of S", "1"),
    Quantity("outside_peak", "|S| outside the band of [sensitivity], if larger", "1"),
    Quantity("unstable", f"members not stable at rest, of the first {MEMBERS}", "1"),
    Quantity("worst_peak", "peak of |S|, worst member", "1"),
    Quantity("t_peak", "peak of |T|", "1"),
    Quantity("ks_peak", "peak of |KS|", "V/m"),
    Quantity("gain_margin_low", "gain margin below 1", "1"),
    Quantity("gain_margin_high", "gain margin above 1", "1", less=False),
    Quantity("phase_margin_deg", "phase margin", "degrees", less=False),
    Quantity("delay_margin_s", "delay margin, the smaller one", "s", less=False),
    Quantity("delay_margin_reading_s", "delay margin at the reading", "s", less=False),
    Quantity("delay_margin_command_s", "delay margin at the command", "s", less=False),
    Quantity("disk_margin", "disk margin", "1", less=False),
    Quantity("stiffness_N_per_m", "static stiffness", "N/m", less=False),
    Quantity("flops", "cost of a step", "flops"),
    *(_of_order(name, unit) for name, unit in response.UNITS.items()),
)

BY_KEY = {q.key: q for q in QUANTITIES}
# Those of each axis of a machine, and their metrics.
OF_AXES = [BY_KEY[key] for key in ("rms_error_median_m", "max_error_m", "max_i_A", "max_u_V")]
BY_AXIS = tuple(q.metric for q in OF_AXES)


def comparison_summary(compared: Sequence[Compared], study: AnyStudy, notes: Sequence[str]) -> dict[str, Any]:
    """Return the content of compare.json: the members, the notes on the cases, and the numbers of each case."""
    rows = [{**_values(one, compared[0]), "laws": laws_of(one.case)} for one in compared]
    return {"members": study.members, "seed": study.seed, "differences": list(notes), "cases": rows}


def _values(one: Compared, first: Compared) -> dict[str, object]:
    case, stalled = one.case, np.asarray(one.columns["stalled"], bool)
    settled = max(float(case.clock.duration) - float(case.settle), float(case.clock.sample_period))
    numbers = {q.key: one.of(q.metric, q.reduce) for q in QUANTITIES}
    chatter, used = numbers["chatter_V_per_s"], numbers["clearance_used"]
    loop = {key: x for key, x in one.loop.numbers.items() if key in numbers or key == "stable"}
    axes = {
        axis: {q.key: one.of(f"{axis}.{q.metric}", q.reduce) for q in OF_AXES} | dict(one.loop.axes.get(axis, {}))
        for axis in (() if isinstance(case, Case) else case.axes)
    }
    return {
        "case": case.name,
        **numbers,
        "lost": int(np.sum(~one.held & ~stalled)),
        "stalled": int(np.sum(stalled)),
        "not_stable": one.findings.unstable,
        "cycle_m": one.findings.swing_m,
        "better_than_first": None if one is first else _better(one, first),
        "chatter_V_per_s": None if chatter is None else chatter / settled,
        "clearance_zone": "D" if used is None or not one.held.all() else case.zones.clearance_zone(used),
        **loop,
        "flops": one.flops,
        **({"axes": axes} if axes else {}),
    }


def _better(one: Compared, first: Compared) -> int:
    """Return the number of members that this case holds and the first case loses, or holds with a larger rms error."""
    ours, theirs = (np.where(x.held, x.columns["settled_rms_error_m"], math.inf) for x in (one, first))
    return int(np.sum(ours < theirs))


def comparison_table(summary: Mapping[str, Any]) -> str:
    """Return the table that the command prints."""
    names = [case["case"] for case in summary["cases"]]
    rows = [(q.words, *(_cell(q.value(case)) for case in summary["cases"]), q.unit) for q in _shown(summary)]
    return "\n".join([table(("", *names, "unit"), rows), "", _words(summary)])


def comparison_markdown(summary: Mapping[str, Any]) -> str:
    """Return the text of the page, which refers to compare.png. The best number of each row is bold."""
    names = [web_page.escape_markdown(case["case"]) for case in summary["cases"]]
    rows = [[q.words.replace("|", "\\|"), *_marked(q, summary), q.unit] for q in _shown(summary)]
    lines = ["# Comparison of controllers", "", _words(summary), ""]
    lines += [f"- {web_page.escape_markdown(note)}" for note in summary["differences"]] + [""]
    lines += [*markdown_table(["", *names, "unit"], rows), "", "![Comparison](compare.png)", ""]
    for name, case in zip(names, summary["cases"], strict=True):
        numbers = [
            [stage, str(law["kind"]), ", ".join(f"{key} = {value:.6g}" for key, value in law.items() if key != "kind")]
            for stage, law in case["laws"].items()
        ]
        lines += [f"## {name}", "", *markdown_table(["stage", "law", "gains"], numbers), ""]
    return "\n".join(lines) + "\n"


def _words(summary: Mapping[str, Any]) -> str:
    bad = ("lost", "stalled", "not_stable")
    poor = [case["case"] for case in summary["cases"] if case["peak"] is None or any(case[key] for key in bad)]
    why = f" Members not held or not stable, or a loop not stable at rest: {', '.join(poor)}." if poor else ""
    why += " See 'ambjax check'." if poor else ""
    machines = "axes" in summary["cases"][0]
    loop = "loops of a machine: its worst axis at its worst speed" if machines else "loop at rest"
    worst = " A metric of a member is that of its worst axis, except by axis." * machines
    return (
        f"{summary['members']} members, seed {summary['seed']}, the same in all cases. Errors, voltages, currents and "
        f"power losses are those of the members that are held.{worst} Sensitivity and margins are those of the "
        f"linearised {loop}.{why}"
    )


def _shown(summary: Mapping[str, Any]) -> list[Quantity]:
    """Return the quantities that at least one case has. The row of stalled members is left out if there are none."""
    cases = summary["cases"]
    axes = dict.fromkeys(axis for case in cases for axis in case.get("axes", ()))
    rows = [*OF_AXES, BY_KEY["peak"], BY_KEY["zone"]]
    of_axes = [q._replace(words=f"{axis}: {q.words}", axis=axis) for axis in axes for q in rows]
    return [
        q
        for q in (*QUANTITIES, *of_axes)
        if any(q.value(case) is not None for case in cases)
        and (q.key != "stalled" or any(case[q.key] for case in cases))
    ]


def _cell(value: object) -> str:
    return number(value) if value is None or isinstance(value, float) else str(value)


def _marked(quantity: Quantity, summary: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row, those with the best printed number bold if not all are equal."""
    values = [quantity.value(case) for case in summary["cases"]]
    cells = [_cell(value) for value in values]
    known = {cell: value for value, cell in zip(values, cells, strict=True) if isinstance(value, (int, float))}
    if quantity.less is None or len(known) < 2:
        return cells
    best = (min if quantity.less else max)(known, key=lambda cell: known[cell])
    return [f"**{cell}**" if cell == best else cell for cell in cells]
