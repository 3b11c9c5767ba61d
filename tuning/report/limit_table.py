"""Limits in the report: allowed and reached values, verdicts, and the effect of a limit that is 10 % looser."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tuning.judge.peaks import DELAY_MARGIN, DelayTest, Sensitivity, not_simulated, reached_of
from tuning.problem.limits import Limit
from tuning.problem.quantities import BY_INJECTION, Kind
from tuning.problem.tuning_problem import TuningProblem
from tuning.report.facts import Column, Row, table

# Share by which a limit is loosened to compute the effect.
MORE = 0.1
# Verdicts on a limit.
HELD, BROKEN, UNVERIFIED, UNJUDGED = "held", "NOT HELD", "not verified", "not judged"
UNBREAKABLE = "cannot be broken"
EMPHASISED = (BROKEN, UNVERIFIED)


def facts(
    problem: TuningProblem,
    columns: Mapping[str, np.ndarray],
    summary: Row,
    refuted: str = "",
    injected: Sensitivity | None = None,
    delayed: DelayTest | None = None,
) -> list[Row]:
    """Return a row for each limit and one for survival, from the held-out members' columns [N] and their summary.

    `refuted`: why accurate steps do not confirm the answer; '' if they do. `injected`: the injections into some of the
    held-out members. `delayed`: the test of the limit on the delay margin. Fields of a row:

    - `held`: whether the limit is held; None if no member was judged, or if the limit is held but accurate steps do not
      confirm the answer. `verdict`: the same in words.
    - `price`: decrease of the minimised settled rms error (m) or voltage (V) for a limit 10 % looser
      (`Limit.error_reduction`). It is None for survival, and if the verdict is not "held". Otherwise it is 0 if the
      limit is not active.
    """
    members, held, settings = summary["members"], summary["held"], problem.tune.limits
    unit, minimised = ("V", "settled_rms_u_V.mean") if problem.goal.minimised else ("m", "settled_rms_error_m")
    rows = list[Row]()
    for limit in _asked(problem):
        reached = reached_of(limit, columns, injected) if held else None
        found = _verdict((reached is not None and limit.holds(reached)) if members else None, refuted)
        active = limit.active(reached)
        price = summary[minimised] * limit.error_reduction(MORE) if active and held else 0.0
        row = _blank(limit.name, limit.threshold, unit, limit.kind, source=limit.source, **found)
        row |= {
            "what": row["what"] + _by_injection(limit, injected),
            "saturated": _saturated(limit, reached, injected),
            "reached": reached,
            "worst": limit.worst(columns) if held and limit.kind.fold else reached,
            "margin": limit.margin,
            "active": active,
            "multiplier": limit.multiplier,
            "price": price if found["held"] else None,
        }
        reason = not_simulated(problem, limit) if limit.name == DELAY_MARGIN else ""
        rows.append(_tested(row, delayed, refuted, reason))
    for limit, why in settings.unbreakable:
        found = {"source": f"{limit.source}; {UNBREAKABLE}: {why}", "verdict": UNBREAKABLE, "held": True}
        rows.append(_blank(limit.name, limit.threshold, unit, limit.kind, **found))
    share = held / members if members else None
    kept = members - held <= settings.may_lose(members) if members else None
    survival = _blank("survival", settings.survival, unit, reached=share, at_least=True)
    return [*rows, survival | _verdict(kept, refuted)]


def _blank(name: str, threshold: float, price_unit: str, kind: Kind | None = None, **found: Any) -> Row:
    """Return the row of a limit without a value reached, with the fields `found`. `kind`: None for survival."""
    return {
        "name": name,
        "unit": kind.unit if kind else "",
        "threshold": threshold,
        "at_least": kind.at_least if kind else False,
        "source": "tune.limits",
        "what": f"{kind.words}; {kind.over}" if kind else "share of members held",
        **dict.fromkeys(("reached", "worst", "multiplier", "price")),
        "margin": 0.0,
        "active": False,
        "price_unit": price_unit,
    } | found


def _verdict(kept: bool | None, refuted: str) -> Row:
    """Return whether a limit is held, and its verdict.

    `kept`: whether the judged value is within the limit; None if no member was judged.
    """
    if kept is None:
        return {"held": None, "verdict": UNJUDGED}
    if not kept:
        return {"held": False, "verdict": BROKEN}
    return {"held": None, "verdict": UNVERIFIED} if refuted else {"held": True, "verdict": HELD}


def _tested(row: Row, delayed: DelayTest | None, refuted: str, reason: str = "") -> Row:
    """Return the row of the delay margin with the result of its test; any other row unchanged.

    `reason`: why there was no test (`not_simulated`).
    """
    if row["name"] != DELAY_MARGIN or (delayed is None and not reason):
        return row
    if delayed is None:
        words = f"the linear margins decide, because {reason}: the additional delay was not simulated"
    else:
        words = (
            f"with this additional delay {delayed.lost} of {delayed.members} of the worst members are lost, and "
            f"{delayed.unstable} held but not stable"
        )
    fails = _verdict(False, refuted) | {"price": None} if delayed and (delayed.lost or delayed.unstable) else {}
    return row | {"what": f"{row['what']}; {words}"} | fails


def _asked(problem: TuningProblem) -> list[Limit]:
    """Return the limits of [tune.limits], in the state of the last search."""
    found = {limit.name: limit for limit in problem.limits if limit.asked}
    return [found.get(limit.name, limit) for limit in problem.tune.limits.each]


def _by_injection(limit: Limit, injected: Sensitivity | None) -> str:
    """Return the text about the injection; '' if injections do not measure the quantity."""
    if limit.name not in BY_INJECTION or injected is None or injected.peaks[0].injected is None:
        return ""
    those = f"by injection into {len(injected.peaks)} of the worst members"
    return f"; {those}" if injected.decides else f", or its value {those}, if that is larger"


def _saturated(limit: Limit, reached: float | None, injected: Sensitivity | None) -> float | None:
    """Return the share of saturated samples of the injection whose value is `reached`; None if no injection gave it."""
    peaks = () if injected is None else injected.peaks
    those = (one.injected for one in peaks if one.injected and one.largest.get(limit.name, np.nan) == reached)
    return next((one.saturated for one in those), None)


def _at_the_supply(row: Row) -> str:
    """Return a warning if the supply limited u during the injection; '' if it did not."""
    share = row.get("saturated")
    if not share:
        return ""
    return (
        f"; by an injection while the supply limits u in {100 * share:.2g} % of the samples: set a smaller "
        "sensitivity.amplitude, or ask for gains with a smaller peak of |KS| by tune.limits.control_sensitivity or a "
        "lower tune.limits.rms_u_V"
    )


def broken(rows: list[Row]) -> list[str]:
    """Return a sentence for each limit that is not held, including survival."""
    return [
        f"tune.limits.{row['name']} is {BROKEN}: "
        f"{'no member is held' if row['reached'] is None else _number(row['reached'], row)}, {_side(row)} "
        f"{row['threshold']:g} ({row['source']}){_at_the_supply(row)}"
        for row in rows
        if row["verdict"] == BROKEN
    ]


def prices(rows: list[Row]) -> list[str]:
    """Return a sentence for each limit that is active and held."""
    return [
        f"{row['name']} = {_number(row['reached'], row)} is at its limit, {row['threshold']:g}: a limit "
        f"{100 * MORE:g} % {'lower' if row['at_least'] else 'higher'} would reduce the settled rms "
        f"{'voltage' if row['price_unit'] == 'V' else 'error'} by about {row['price']:.2g} {row['price_unit']}"
        for row in rows
        if row["active"] and row["held"]
    ]


def section(rows: list[Row]) -> list[str]:
    """Return the section on limits."""
    if not rows:
        return []
    columns: dict[str, Column] = {
        "quantity": lambda row: f"`{row['name']}`",
        "limit": lambda row: f"{_side(row)} {row['threshold']:g} {row['unit']}".rstrip(),
        "reached": lambda row: _number(row["reached"], row),
        "worst member": lambda row: _number(row["worst"], row),
        "verdict": lambda row: f"**{row['verdict']}**" if row["verdict"] in EMPHASISED else row["verdict"],
        "at the optimum": lambda row: "active" if row["active"] else "-",
        f"effect if {100 * MORE:g} % looser": lambda row: (
            "-" if row["price"] is None else f"{row['price']:.2g} {row['price_unit']}"
        ),
    }
    sources = "\n".join(f"- {row['name']}: {row['what']}. Source: {row['source']}." for row in rows)
    words = (
        "The values are those of the held-out members that are held. Last column: estimated decrease of the minimised "
        f"settled rms error or voltage if the limit were {100 * MORE:g} % looser."
    )
    return ["## Limits", table(rows, columns), sources, words]


def _side(row: Row) -> str:
    return "at least" if row["at_least"] else "at most"


def _number(value: float | None, row: Row) -> str:
    return "-" if value is None else f"{value:.4g} {row['unit']}".rstrip()
