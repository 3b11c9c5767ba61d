"""`ambjax map`: survival and error over a grid of two quantities, for one or more cases."""

import argparse
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambjax.cases.machine_case import AnyCase
from ambjax.commands.reading import read_any_with_warnings, results
from ambjax.ensemble.intervals import wilson
from ambjax.ensemble.maps import CERTAIN, GRIDS, Map
from ambjax.host.heartbeat import FIRST_RUN, doing, say
from ambjax.results.case_map import computed, figure_of, study_and_axes
from ambjax.results.outputs import directory, drawn, plain, table, write_json

WRITTEN = ("map.png", "map.json")


def run(args: argparse.Namespace) -> tuple[int, Mapping[str, object]]:
    """Simulate the cells of a map for each case and write map.png and map.json."""
    cases = [read_any_with_warnings(path) for path in [args.case, *(args.against or [])]]
    ready = [study_and_axes(cases[0], args.x, args.y, args.members, args.seed)]
    for path, case in zip(args.against or [], cases[1:], strict=True):
        try:
            ready += [study_and_axes(case, args.x, args.y, args.members, args.seed)]
        except ValueError as error:
            raise ValueError(f"--against {path}: {error}") from None
    out = directory(args.out, f"map-{cases[0].name}", WRITTEN, args.force)
    maps: list[Map] = []
    with results(args, out, WRITTEN, lambda: _text(cases, maps)) as part:
        for case, (study, x, y) in zip(cases, ready, strict=True):
            say(f"{case.name}: {len(x.values) * len(y.values)} cells of {args.members}; method: {study.clock.method}")
            if args.members == 1 and case.spread.entries:
                say(f"{case.name}: nominal, because one member does not draw the [spread]; --members 2 or more do.")
            with doing(f"{case.name}: simulating the cells; {FIRST_RUN}"):
                maps.append(computed(case, study, x, y))
        summary = {"cases": [_summary(case, one) for case, one in zip(cases, maps, strict=True)], "out": str(out)}
        write_json(part / "map.json", summary)
        drawn(part / "map.png", lambda: figure_of(cases, maps), 150)
    return 0, plain(summary)


def _text(cases: Sequence[AnyCase], maps: list[Map]) -> str:
    first, sure = maps[0], any(one.decisive for one in maps)
    rows, lines = [], []
    for case, one in zip(cases, maps, strict=True):
        reach = one.reach()
        held = "nowhere" if reach is None else f"{reach[0]:.4g} to {reach[1]:.4g}{_open_ends(one, reach)}"
        cells = [f"{100 * share:.1f} %" for share in (one.survival.mean(), np.mean(one.survival == 1))]
        cells += [f"{100 * np.mean(one.low >= CERTAIN):.1f} %" if one.decisive else "-"] * sure
        rows.append((case.name, *cells, held))
        drawn = f"drawn for each member: {', '.join(one.drawn)}" if one.drawn else "nominal: no quantity is drawn"
        lines += [f"{case.name}: {drawn}"]
        if one.unstable.any():
            many = f"{int(one.unstable.sum())} of {one.unstable.size} cells"
            lines += [f"{case.name}: in {many} the rotor is held, but the loop is NOT stable (hatched in map.png)"]
        if not one.decisive:
            lines += [f"{case.name}: {_confidence_note(one)}"]
        if one.stalled.any():
            many, lost = int(one.stalled.sum()), int(one.lost.sum())
            where = f"in {np.count_nonzero(one.stalled)} cells"
            lines += [f"{case.name}: {lost} runs lost, {many} not decided ({where}): the integrator stalled there"]
    header = ["case", "runs that survive", "cells in which all survive"]
    header += [f"cells above {100 * CERTAIN:g} % with confidence"] * sure
    header += [f"{first.x.path} survived, stable, at {first.y.path} = {first.y.values[first.middle]:.3g}"]
    return "\n".join([table(header, rows), *lines])


def _open_ends(one: Map, reach: tuple[float, float]) -> str:
    """Say at which ends the interval is limited by the map and not by a lost rotor."""
    values = sorted((float(one.x.values[0]), float(one.x.values[-1])))
    ends = [name for name, x, end in zip(("lower", "upper"), sorted(reach), values, strict=True) if x == end]
    return f" ({' and '.join(ends)} end of the map)" if ends else ""


def _confidence_note(one: Map) -> str:
    """Explain why a map gives no confidence statement for its cells."""
    if not one.varied:
        return "without noise and [spread], all runs of a cell are the same, so one run decides the cell"
    enough = next(n for n in itertools.count(1) if wilson(n, n).low >= CERTAIN)
    runs = f"{one.members} run{'s' * (one.members > 1)} a cell"
    return f"{runs}: too few for a confidence statement about a cell; give --members {enough} or more"


def _summary(case: AnyCase, one: Map) -> Mapping[str, object]:
    facts: dict[str, Any] = {"case": case.name, "x": one.x._asdict(), "y": one.y._asdict()}
    return facts | {key: getattr(one, key) for key in (*GRIDS, "members", "drawn", "decisive")} | {"reach": one.reach()}
