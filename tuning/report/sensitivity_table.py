"""The sensitivity in the report: linear and injected peaks of |S| of held-out members, and their zones."""

import dataclasses
from typing import Any

from ambjax.text.web_page import escape_markdown, markdown_table
from tuning.judge.peaks import SCREENED, Sensitivity, injects
from tuning.problem.tuning_problem import TuningProblem

Facts = dict[str, Any]
# Text in place of the linear peak of a loop without one, by its zone.
NO_PEAK = {"D": "unstable", None: "not computed"}


def facts(problem: TuningProblem, measured: Sensitivity) -> Facts:
    """Return plain data: a row for each member of `measured`, and the limits of the zones.

    `zone` of a row is that of the linear peak, `injected_zone` that of the injected one. `why`: why there is no linear
    peak; '' if there is one.
    """
    zones = problem.case.zones
    rows = []
    for one in measured.peaks:
        row = {name: value for name, value in dataclasses.asdict(one).items() if name != "largest"}
        row["injected_zone"] = "D" if one.lost else None if one.peak is None else zones.zone(one.peak)
        rows.append(row)
    limits = [float(x) for x in (zones.zone_a, zones.zone_b, zones.zone_c)]
    return {"members": rows, "injected": injects(problem), "decides": measured.decides, "zones": limits}


def section(found: Facts | None) -> list[str]:
    """Return the section on the sensitivity."""
    if found is None:
        return []
    cells = [
        [
            str(row["member"]),
            *([_number(row["linear"]), _number(row["frequency_hz"])] if row["linear"] else [NO_PEAK[row["zone"]], "-"]),
            row["zone"] or "-",
            *(_injected(row) if found["injected"] else []),
        ]
        for row in found["members"]
    ]
    head = ["member", "linear peak of |S|", "at (Hz)", "zone"]
    if found["injected"]:
        head += ["injected peak", "95 % interval", "at (Hz)", "zone", "saturated"]
    a, b, c = found["zones"]
    which = "The held-out members with the largest linear peaks."
    if found["decides"]:
        which = f"The members with the largest peaks, measured by one injection into each of up to {SCREENED} members."
    words = [f"{which} Zone A is below {a:g}, B below {b:g}, C below {c:g}."]
    if found["decides"]:
        words.append("A sign is set-valued: the injected peak decides, because no linear loop describes chattering.")
    elif found["injected"]:
        words.append("The larger of the linear and the injected peak decides.")
    else:
        words.append(
            "In continuous time the linear peak decides. `ambjax sensitivity --inject` measures the peak in a "
            "simulation."
        )
    if any(row["saturated"] for row in found["members"]):
        words.append(
            "The supply limits the voltage during the injection, so the measured peak describes the limited loop. A "
            "smaller `sensitivity.amplitude` measures the loop without this limit."
        )
    unknown = [f"- Member {row['member']}: {escape_markdown(row['why'])}." for row in found["members"] if row["why"]]
    unknown += [""] * bool(unknown)
    return ["## Sensitivity", "", *markdown_table(head, cells), "", *unknown, " ".join(words), ""]


def _injected(row: Facts) -> list[str]:
    if row["lost"]:
        return [f"lost: {row['lost']} of {row['repetitions']}", "-", "-", row["injected_zone"], "-"]
    if row["peak"] is None:
        return ["-"] * 5
    interval = "-" if row["low"] is None else f"{row['low']:.4g} to {row['high']:.4g}"
    saturated = f"{100 * row['saturated']:.2g} %"
    return [_number(row["peak"]), interval, _number(row["at_hz"]), row["injected_zone"], saturated]


def _number(x: float) -> str:
    return f"{x:.4g}"
