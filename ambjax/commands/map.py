"""`ambjax map`: survival and error over a grid of two quantities, for one or more cases."""

import argparse
import itertools
import math
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambjax.cases.reader import Case
from ambjax.cases.timing import FEWEST_SAMPLES, MOST_SAMPLES, SAMPLE_PERIOD
from ambjax.commands.ensemble import study_of
from ambjax.commands.outputs import directory, files, plain, say, table, write_json, written
from ambjax.commands.warnings import read_with_warnings
from ambjax.ensemble.intervals import wilson
from ambjax.ensemble.maps import CERTAIN, GRIDS, PERIOD, Axis, Map, grid, stepped
from ambjax.ensemble.paths import Place, places
from ambjax.numerics.records import numbers, within

WRITTEN = ("map.png", "map.json")
COUNT = 21
MOST_CELLS = 1_000_000
# Most samples of all runs in a map over clock.sample_period, some hours of computation.
MOST_TOTAL = 10_000_000_000
FORM = "PATH=LOW:HIGH[:COUNT][:log], as in initial.z=-1e-3:1e-3:41 or plant.m=-20%:20%"


def run(args: argparse.Namespace) -> tuple[int, Mapping[str, object]]:
    """Simulate the cells of a map for each case and write map.png and map.json."""
    cases = [read_with_warnings(path) for path in [args.case, *(args.against or [])]]
    studies = [study_of(case, args.seed, args.members) for case in cases]
    axes = [(_axis("--x", args.x, case), _axis("--y", args.y, case)) for case in cases]
    cells = len(axes[0][0].values) * len(axes[0][1].values)
    if cells * args.members > MOST_CELLS:
        raise ValueError(
            f"--members {args.members}: times {cells} cells, it exceeds {MOST_CELLS:,} runs. Reduce either."
        )
    for case, (x, y) in zip(cases, axes, strict=True):
        _check_samples(case, x, y, args.members)
    studies = [stepped(study, x, y) for study, (x, y) in zip(studies, axes, strict=True)]
    out = directory(args.out, f"map-{cases[0].name}", WRITTEN, args.force)
    with files(out) as part:
        maps = []
        for case, study, (x, y) in zip(cases, studies, axes, strict=True):
            say(f"{case.name}: {cells} cells of {args.members}; method: {study.clock.method}")
            if args.members == 1 and case.spread.entries:
                say(f"{case.name}: nominal: one member does not draw the [spread]; --members 2 or more does.")
            maps.append(grid(study, x, y))
        summary = {"cases": [_summary(case, one) for case, one in zip(cases, maps, strict=True)], "out": str(out)}
        _draw(cases, maps, part / "map.png")
        write_json(part / "map.json", summary)
    if not args.json:
        print(_text(cases, maps))
        written(out, ", ".join(WRITTEN))
    return 0, plain(summary)


def _axis(flag: str, text: str, case: Case) -> Axis:
    """Parse the value of --x or --y. Raises ValueError with the option, its text and the valid form."""

    def refuse(why: str) -> ValueError:
        return ValueError(f"{flag} {text}: {why}. Write {FORM}.")

    path, _, rest = text.partition("=")
    parts = rest.split(":")
    log = parts[-1] == "log"
    parts = parts[:-1] if log else parts
    if len(parts) not in (2, 3):
        raise refuse("it must be a path, '=' and a range")
    known = places(case.cascade, case.scenario)
    nominal = float(case.clock.sample_period) if path == PERIOD else _nominal(known.get(path))
    try:
        low, high = (_value(part, nominal) for part in parts[:2])
        count = int(parts[2]) if len(parts) == 3 else COUNT
    except ValueError as error:
        raise refuse(str(error)) from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise refuse(f"LOW must be less than HIGH, both finite; they are {low:g} and {high:g}")
    if not 2 <= count <= MOST_CELLS:
        raise refuse(f"COUNT must be 2 to {MOST_CELLS:,}, and it is {count}")
    field = SAMPLE_PERIOD if path == PERIOD else known[path].field if path in known else None
    if field is not None and not within(field.metadata, np.array([low, high])):
        raise refuse(f"{path} must be {numbers(field)}, and the range is {low:g} to {high:g}")
    if log and low <= 0:
        raise refuse(f"a logarithmic range must begin above 0, and it begins at {low:g}")
    return Axis(path, np.geomspace(low, high, count) if log else np.linspace(low, high, count), log)


def _check_samples(case: Case, x: Axis, y: Axis, members: int) -> None:
    """Raise ValueError for sample periods too long for the run, or a map with too many samples."""
    for flag, axis, other in (("--x", x, y), ("--y", y, x)):
        if axis.path != PERIOD:
            continue
        duration, low, high = float(case.clock.duration), float(axis.values[0]), float(axis.values[-1])
        total = np.sum(duration / axis.values) * len(other.values) * members
        samples = np.round(duration / axis.values)
        if samples.min() < FEWEST_SAMPLES:
            raise ValueError(
                f"{flag} {PERIOD}: it reaches {high:g} s, but clock.duration is {duration:g} s, and a run needs "
                f"{FEWEST_SAMPLES} samples. Set HIGH to at most {duration / FEWEST_SAMPLES:g} s."
            )
        unsettled = axis.values[(samples - 1) * axis.values < case.settle]
        if unsettled.size:
            raise ValueError(
                f"{flag} {PERIOD}: with {unsettled[0]:g} s no sample is at or after run.settle = {case.settle:g} s. "
                "Lower HIGH or run.settle."
            )
        if duration / low > MOST_SAMPLES or total > MOST_TOTAL:
            raise ValueError(
                f"{flag} {PERIOD}: from {low:g} s on, it makes runs of up to {duration / low:.3g} samples, {total:.3g} "
                f"in all; at most {MOST_SAMPLES:,} a run and {MOST_TOTAL:.0e} in all are allowed. Raise LOW, or "
                "shorten clock.duration."
            )


def _nominal(place: Place | None) -> float | None:
    return None if place is None or place.value is None else float(place.value)


def _value(text: str, nominal: float | None) -> float:
    if not text.endswith("%"):
        return float(text)
    if nominal is None or not math.isfinite(nominal) or nominal == 0:
        raise ValueError("per cent need a number other than 0 in the case, and the case has none at this path")
    return nominal * (1 + float(text[:-1]) / 100)


def _summary(case: Case, one: Map) -> Mapping[str, object]:
    facts: dict[str, Any] = {"case": case.name, "x": one.x._asdict(), "y": one.y._asdict()}
    return facts | {key: getattr(one, key) for key in (*GRIDS, "members", "drawn", "decisive")} | {"reach": one.reach()}


def _text(cases: list[Case], maps: list[Map]) -> str:
    first, sure = maps[0], any(one.decisive for one in maps)
    rows, lines = [], []
    for case, one in zip(cases, maps, strict=True):
        reach = one.reach()
        held = "nowhere" if reach is None else f"{reach[0]:.4g} to {reach[1]:.4g}"
        cells = [f"{100 * share:.1f} %" for share in (one.survival.mean(), np.mean(one.survival == 1))]
        cells += [f"{100 * np.mean(one.low >= CERTAIN):.1f} %" if one.decisive else "-"] * sure
        rows.append((case.name, *cells, held))
        lines += [f"{case.name}: {_spread_words(one)}"]
        if not one.decisive:
            lines += [f"{case.name}: {_confidence_note(one)}"]
        if one.stalled.any():
            many, lost = int(one.stalled.sum()), int(one.lost.sum())
            where = f"in {np.count_nonzero(one.stalled)} cells"
            lines += [f"{case.name}: {lost} runs lost, {many} not decided ({where}): the integrator stalled there"]
    header = [
        "case",
        "runs that survive",
        "cells in which all survive",
        *[f"cells above {100 * CERTAIN:g} % with confidence"] * sure,
    ]
    head = f"{first.x.path} survived at {first.y.path} = {first.y.values[first.middle]:.3g}"
    return "\n".join([table([*header, head], rows), *lines])


def _confidence_note(one: Map) -> str:
    """Explain why a map gives no confidence statement for its cells."""
    if not one.varied:
        return "without noise and [spread], all runs of a cell are the same, and one decides it"
    enough = next(n for n in itertools.count(1) if wilson(n, n).low >= CERTAIN)
    runs = f"{one.members} run{'s' * (one.members > 1)} a cell"
    return f"{runs}: too few for a confidence statement about a cell; give --members {enough} or more"


def _spread_words(one: Map) -> str:
    """Return in words which quantities a map draws for each member."""
    return f"drawn for each member: {', '.join(one.drawn)}" if one.drawn else "nominal: no quantity is drawn"


def _draw(cases: list[Case], maps: list[Map], path: pathlib.Path) -> None:
    from ambjax.pictures import heatmaps

    panels = [
        {
            "title": f"{case.name}\n{_short(m)}",
            "x": m.x.values,
            "y": m.y.values,
            "survival": m.survival,
            "low": m.low if m.decisive else None,
            "high": m.high if m.decisive else None,
            "error": m.error,
        }
        for case, m in zip(cases, maps, strict=True)
    ]
    x, y = maps[0].x, maps[0].y
    heatmaps.maps(panels, _label(cases[0], x), _label(cases[0], y), x.log, y.log, path)


def _short(one: Map) -> str:
    """Return the subtitle of a panel: the spread quantities, or their number if there are more than three."""
    few = len(one.drawn) <= 3
    what = ", ".join(one.drawn) if few else f"{len(one.drawn)} quantities"
    words = f"spread: {what}" if what else "nominal"
    return words + f"; {int(one.stalled.sum())} runs not decided" * bool(one.stalled.any())


def _label(case: Case, axis: Axis) -> str:
    place = places(case.cascade, case.scenario).get(axis.path)
    unit = "s" if place is None else place.field.metadata["unit"]
    return f"{axis.path} ({unit})" if unit else axis.path
