"""Tables for notebooks: that of the parts of a case and their numbers, and of results."""

import dataclasses
import html
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.numerics.records import GainFunction
from ambjax.numerics.shapes import axes_of
from ambjax.simulation.clock import Clock
from ambjax.world.scenario import SLOTS, Scenario
from ambjax.world.waveforms import Constant

# Unit of each signal of a scenario.
UNITS = {"reference": "m", "q_z": "m/s^2", "q_v": "A^2/m^2", "q_i": "A/s", "q_f": "N", "base": "m/s^2"}


def parts_of(cascade: Cascade, scenario: Scenario, clock: Clock) -> dict[str, str]:
    """Return the type and the numbers of each part, with units, by its name.

    Absent parts, zero signals, an unlimited supply, and a model with the numbers of the plant are omitted.
    """
    laws = {stage: getattr(cascade, stage) for stage in ("observer", "position", "inversion", "current")}
    given = {slot: getattr(scenario, slot) for slot in SLOTS}
    signals = {f"{slot} ({UNITS[slot]})": one for slot, one in given.items() if one != Constant()}
    same = _numbers_of(cascade.model) == _numbers_of(scenario.plant)
    plants = {"plant": scenario.plant, "model": None if same else cascade.model}
    beside = {"notch": cascade.notch, "processor": cascade.processor}
    world = {"rotor": scenario.rotor, "sensor": scenario.sensor, "actuator": scenario.amplifier, "stop": scenario.stop}
    parts = plants | laws | beside | signals | world
    parts_text = {name: _described(one) for name, one in parts.items() if one is not None}
    supply, period = float(np.max(scenario.u_max)), float(clock.sample_period)
    limit = {"supply": f"{supply:g} V"} if np.isfinite(supply) else {}
    return parts_text | limit | {"clock": f"{clock.samples} samples of {period:g} s, {clock.method}"}


def _described(part: object) -> str:
    return ": ".join(filter(None, (type(part).__name__, _numbers_of(part))))


def _numbers_of(part: object) -> str:
    """Return the numbers of a record with their units, separated by commas; nested records are in parentheses."""
    words = []
    for field in dataclasses.fields(part) if dataclasses.is_dataclass(part) else ():
        value, unit = getattr(part, field.name), field.metadata.get("unit", "")
        if isinstance(value, GainFunction):
            words.append(f"{field.name} scheduled")
        elif field.metadata.get("leaf") and value is not None:
            shown = _shown(value) if np.ndim(value) == len(axes_of(field)) else f"{len(value)} values"
            words.append(f"{field.name} = {shown}{f' {unit}' if unit not in ('', '1') else ''}")
        elif dataclasses.is_dataclass(value):
            words.append(f"{field.name} ({_described(value)})")
    return ", ".join(words)


def _shown(value: Any) -> str:
    return f"{float(value):g}" if np.ndim(value) == 0 else f"[{', '.join(map(_shown, value))}]"


def notebook_table(caption: str, titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table of escaped texts. Without rows, it has its caption only."""
    cells = lambda row, kind: "".join(f"<{kind}>{html.escape(x)}</{kind}>" for x in row)  # noqa: E731
    lines = [cells(row, "td") for row in rows]
    lines = [f"<tr>{line}</tr>" for line in ([cells(titles, "th"), *lines] if lines else [])]
    return f"<table><caption>{html.escape(caption)}</caption>{''.join(lines)}</table>"
