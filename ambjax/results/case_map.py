"""`survival_map`: the map of the command `ambjax map` as a Python object."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ambjax.cases.case_table import notebook_table
from ambjax.cases.given import names_arguments, of_case
from ambjax.cases.machine_case import AnyCase
from ambjax.cases.timing import FEWEST_SAMPLES, MOST_SAMPLES, SAMPLE_PERIOD
from ambjax.ensemble.maps import GRIDS, PERIOD, Axis, Map, grid, with_method_for_axes
from ambjax.ensemble.paths import Place
from ambjax.ensemble.spread import no_such_number
from ambjax.ensemble.study import AnyStudy, Study
from ambjax.host.extensions import extra
from ambjax.host.one_thread import one_thread
from ambjax.linear import stability_of
from ambjax.numerics.declared import numbers, within
from ambjax.results.cell_gains import gains_of_cells, with_speeds_for
from ambjax.results.machine_study import MachineStudy
from ambjax.results.spread_runs import study_of

COUNT = 21
MOST_CELLS = 1_000_000
# Largest number of samples of all runs together, in a map over clock.sample_period: some hours of computation.
MOST_TOTAL = 10_000_000_000
FORM = "PATH=LOW:HIGH[:COUNT][:log], as in initial.z=-1e-3:1e-3:41 or plant.m=-20%:20%"
# Unit and meaning of each array of a map.
MEANINGS = {
    "survival": ("1", "share of survivors"),
    "low": ("1", "lower end of the 95 % interval of the survival"),
    "high": ("1", "upper end of the 95 % interval of the survival"),
    "error": ("m", "median over the survivors of the largest settled |z - r|"),
    "lost": ("1", "number of members whose rotor is lost"),
    "stalled": ("1", "number of members whose integration stopped early"),
    "unstable": ("1", "1 where member 0 is held, but its loop is not stable"),
}


@dataclasses.dataclass(frozen=True)
class CaseMap:
    """The result of `survival_map`: the case, and the `Map` with arrays [ny, nx] in SI units.

    A notebook shows the smallest and largest values of each array.
    """

    case: AnyCase
    map: Map

    def to_xarray(self) -> Any:
        """Return the arrays as an xarray Dataset, with the dotted paths of y and x as dimensions and units in `attrs`.

        Raises ValueError if xarray is not installed.
        """
        one, dims = self.map, (self.map.y.path, self.map.x.path)
        grids = {name: (dims, getattr(one, name), {"units": u, "long_name": w}) for name, (u, w) in MEANINGS.items()}
        axes = {axis.path: (axis.path, axis.values, {"units": unit_of(self.case, axis)}) for axis in (one.y, one.x)}
        facts = {"case": self.case.name, "members": one.members, "drawn": ", ".join(one.drawn)}
        return extra("xarray").Dataset(grids, axes, facts)

    def plot(self) -> Any:
        """Return a matplotlib Figure with heat maps of the survival and of the error, as map.png shows them."""
        return figure_of([self.case], [self.map])

    def _repr_html_(self) -> str:
        one = self.map
        head = f"{self.case.name}: {one.members} member(s) in each cell of {one.x.path} and {one.y.path}"
        grids = {name: getattr(one, name)[np.isfinite(getattr(one, name))] for name in GRIDS}
        rows = [
            (MEANINGS[name][1], f"{x.min():.6g}", f"{x.max():.6g}", MEANINGS[name][0].strip("1"))
            for name, x in grids.items()
            if x.size
        ]
        return notebook_table(head, ("quantity", "smallest", "largest", "unit"), rows)


@of_case(machines=True)
@names_arguments()
@one_thread()
def survival_map(case: AnyCase, x: str, y: str, *, members: int = 1, seed: int | None = None) -> CaseMap:
    """Return survival and error over a grid of two quantities of a case, as `ambjax map` computes them.

    - `case`: from `read_case` or `read_machine`.
    - `x`, `y`: quantity and range of each axis, in the form of the command's options: "PATH=LOW:HIGH[:COUNT][:log]".
      LOW and HIGH are in SI units, or changes of the value in the case in per cent: -20% is 0.8 times this value.
      COUNT is 21 by default.
      A gain that the file leaves out has the default for clock.sample_period, processor and controller.model of the
      cell; other gains are those of the case.
    - `members`: number of members in each cell; 1 is the nominal case, and 2 or more draw the spread of the case.
    - `seed`: of the spread and the noise; None: `run.seed` of the case.

    Returns a `CaseMap`. Raises ValueError for an unknown quantity, a range that the case does not allow, and too many
    runs.

        grid = ambjax.survival_map(case, "initial.z=-2e-4:2e-4:21", "plant.m=-20%:20%:11")
        grid.map.survival  # [11, 21]
    """
    for name, axis in (("x", x), ("y", y)):
        if not isinstance(axis, str):
            raise ValueError(f"{name} = {axis!r}: it must be text. Write {FORM}.")
    study, first, second = study_and_axes(case, x, y, members, seed)
    return CaseMap(case, computed(case, study, first, second))


def computed(case: AnyCase, study: AnyStudy, x: Axis, y: Axis) -> Map:
    """Return `grid` of a study of a case, with the test of stability, and with the default gains of each cell."""
    return grid(study, x, y, is_stable, functools.partial(gains_of_cells, case))


def is_stable(study: AnyStudy, values: dict[str, np.ndarray], members: np.ndarray) -> np.ndarray:
    """Return whether each system is stable [N], for `grid`. Of a machine, the linear loops are tested."""
    if isinstance(study, MachineStudy):
        return study.stable(values, members)
    assert isinstance(study, Study)
    return stability_of(*study.varied(values, members), study.clock).stable


def study_and_axes(
    case: AnyCase, x: str, y: str, members: int, seed: int | None
) -> tuple[Study | MachineStudy, Axis, Axis]:
    """Return the study and the axes of a map. Raises ValueError as `survival_map` does."""
    study = study_of(case, seed, members)
    first, second = _axis("--x", x, case), _axis("--y", y, case)
    cells = len(first.values) * len(second.values)
    if cells * members > MOST_CELLS:
        raise ValueError(f"--members {members}: with {cells} cells, more than {MOST_CELLS:,} runs. Reduce either.")
    _check_samples(case, first, second, members)
    axes = {axis.path: axis.values for axis in (first, second)}
    if isinstance(study, MachineStudy):
        return study.with_steps_for(axes), first, second
    return with_speeds_for(with_method_for_axes(study, first, second), axes), first, second


def _places(case: AnyCase) -> dict[str, Place]:
    return study_of(case, 0, 1).places()


def unit_of(case: AnyCase, axis: Axis) -> str:
    """Return the unit of the quantity on an axis."""
    place = _places(case).get(axis.path)
    return "s" if place is None else place.field.metadata["unit"]


def title(case: AnyCase, one: Map) -> str:
    """Return the title of a map: the case, and the spread quantities, or their number if there are more than three."""
    few = len(one.drawn) <= 3
    what = ", ".join(one.drawn) if few else f"{len(one.drawn)} quantities"
    words = f"{case.name}\nspread: {what}" if what else f"{case.name}\nnominal"
    return words + f"; {int(one.stalled.sum())} runs not decided" * bool(one.stalled.any())


def figure_of(cases: Sequence[AnyCase], maps: Sequence[Map]) -> Any:
    """Return the picture of the maps of cases over the same axes."""
    from ambjax.pictures.heatmaps import map_figure

    return map_figure(maps, list(map(title, cases, maps)), [unit_of(cases[0], axis) for axis in (maps[0].x, maps[0].y)])


def _axis(flag: str, text: str, case: AnyCase) -> Axis:
    """Parse the value of --x or --y. Raises ValueError with the option, its text and the valid form."""

    def refuse(why: str) -> ValueError:
        return ValueError(f"{flag} {text}: {why}. Write {FORM}.")

    path, _, rest = text.partition("=")
    parts = rest.split(":")
    log = parts[-1] == "log"
    parts = parts[:-1] if log else parts
    if len(parts) not in (2, 3):
        raise refuse("it must be a path, '=' and a range")
    known = _places(case)
    if path != PERIOD and path not in known:
        raise ValueError(f"{flag} {path}: {no_such_number(path, [*known, PERIOD])}")
    given = case.clock.sample_period if path == PERIOD else known[path].value
    nominal = None if given is None else float(given)
    try:
        low, high = (_value(part, nominal) for part in parts[:2])
        count = int(parts[2]) if len(parts) == 3 else COUNT
    except ValueError as error:
        raise refuse(str(error)) from None
    if nominal is not None and nominal < 0 and all(part.endswith("%") for part in parts[:2]):
        low, high = high, low  # -20% of a negative number is the larger one
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise refuse(f"LOW must be less than HIGH, both finite; they are {low:g} and {high:g}")
    if not 2 <= count <= MOST_CELLS:
        raise refuse(f"COUNT must be 2 to {MOST_CELLS:,}, and it is {count}")
    field = SAMPLE_PERIOD if path == PERIOD else known[path].field
    if not within(field.metadata, np.array([low, high])):
        raise refuse(f"{path} must be {numbers(field)}, and the range is {low:g} to {high:g}")
    if log and low <= 0:
        raise refuse(f"a logarithmic range must begin above 0, and it begins at {low:g}")
    return Axis(path, np.geomspace(low, high, count) if log else np.linspace(low, high, count), log)


def _check_samples(case: AnyCase, x: Axis, y: Axis, members: int) -> None:
    """Raise ValueError if a sample period is too long for the run, or if a run or the map has too many samples."""
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
                f"{flag} {PERIOD}: with {low:g} s a run has {duration / low:.3g} samples, and all runs {total:.3g}; "
                f"at most {MOST_SAMPLES:,} a run and {MOST_TOTAL:.0e} in all are allowed. Raise LOW, or "
                "shorten clock.duration."
            )


def _value(text: str, nominal: float | None) -> float:
    if not text.endswith("%"):
        return float(text)
    if nominal is None or not math.isfinite(nominal) or nominal == 0:
        raise ValueError("per cent need a number other than 0 in the case, and the case has none at this path")
    return nominal * (1 + float(text[:-1]) / 100)
