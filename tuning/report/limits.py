"""Limits in the report: asked, reached by the members that judge, held or not, and what 10 % more would buy."""

from typing import Any

import numpy as np

from tuning.config import Limits
from tuning.objective.limits import Limit
from tuning.report.page import table

Facts = dict[str, Any]
# What more of a limit is priced.
MORE = 0.1


def facts(limits: tuple[Limit, ...], asked: Limits, columns: dict[str, np.ndarray], summary: Facts) -> list[Facts]:
    """A row for each limit, and one for survival, of the held-out members' columns [N] (of `judge`) and summary.

    `price_m`: what a limit 10 % higher takes off the settled rms error, m (`Limit.bought`). None where the limit is not
    held, or nobody judges.
    """
    members, held = summary["members"], summary["held"]
    share = held / members if members else None
    survival = {
        "name": "survival",
        "unit": "",
        "asked": asked.survival,
        "source": "tune.limits",
        "what": "share of members held",
        "reached": share,
        "worst": None,
        "margin": 0.0,
        "active": False,
        "multiplier": None,
        "price_m": None,
        "held": None if share is None else members - held <= asked.may_lose(members),
    }
    return [*(_row(limit, columns, summary) for limit in limits), survival]


def _row(limit: Limit, columns: dict[str, np.ndarray], summary: Facts) -> Facts:
    reached = limit.reached(columns) if columns else None
    held = None if reached is None else bool(reached <= limit.asked)
    active = limit.multiplier > 0
    price = summary["settled_rms_error_m"] * limit.bought(MORE) if columns else 0.0
    return {
        "name": limit.name,
        "unit": limit.kind.unit,
        "asked": limit.asked,
        "source": limit.source,
        "what": f"{limit.kind.words}; {limit.kind.over}",
        "reached": reached,
        "worst": float(np.max(limit.of_members(columns))) if columns else None,
        "margin": limit.margin,
        "active": active,
        "multiplier": limit.multiplier,
        "price_m": price if active and held else (0.0 if held else None),
        "held": held,
    }


def broken(rows: list[Facts]) -> list[str]:
    """A sentence for each limit that is not held."""
    return [
        f"tune.limits.{row['name']} is NOT HELD: {row['reached']:.4g}{_unit(row)}, at most {row['asked']:g} "
        f"({row['source']})"
        for row in rows
        if row["held"] is False and row["name"] != "survival"
    ]


def prices(rows: list[Facts]) -> list[str]:
    """A sentence for each limit that is active, and held."""
    return [
        f"{row['name']} = {row['reached']:.4g}{_unit(row)} is at its limit, {row['asked']:g}: {100 * MORE:g} % more "
        f"would take about {row['price_m']:.2g} m off the settled rms error"
        for row in rows
        if row["active"] and row["held"]
    ]


def section(rows: list[Facts]) -> list[str]:
    """Limits as a part of the report."""
    if not rows:
        return []
    verdicts = {True: "held", False: "**NOT HELD**", None: "-"}
    cells = [
        [
            f"`{row['name']}`",
            f"{'at least' if row['name'] == 'survival' else 'at most'} {row['asked']:g}{_unit(row)}",
            _number(row["reached"], row),
            _number(row["worst"], row),
            verdicts[row["held"]],
            "active" if row["active"] else "-",
            "-" if row["price_m"] is None or row["name"] == "survival" else f"{row['price_m']:.2g} m",
        ]
        for row in rows
    ]
    head = ["limit", "asked", "reached", "worst member", "verdict", "at the optimum", f"{100 * MORE:g} % more buys"]
    lines = ["## Limits", "", *table(head, cells), ""]
    lines += [f"- {row['name']}: {row['what']}; asked by {row['source']}." for row in rows]
    return [
        *lines,
        "",
        "Reached by the held-out members. An active limit costs error: the last column is by how much the settled rms "
        "error would fall, from the multipliers of the optima that the search came by.",
        "",
    ]


def _unit(row: Facts) -> str:
    return f" {row['unit']}" if row["unit"] else ""


def _number(value: float | None, row: Facts) -> str:
    return "-" if value is None else f"{value:.4g}{_unit(row)}"
