"""Maps: survival and error over a grid of two quantities. Each cell of the grid is a small ensemble."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ambjax.ensemble.distributions import Choice, Distribution, Uniform
from ambjax.ensemble.intervals import wilson
from ambjax.ensemble.spread import STEP_PATHS, Spread, SpreadError, check_spread, corners, drawn, ends, no_such_number
from ambjax.ensemble.study import PERIOD, AnyStudy, Study
from ambjax.host.sealed import Arrays
from ambjax.simulation.method import choose_method

# Survival of a cell is certain if the lower end of its interval is at least this share.
CERTAIN = 0.95
# Fields of a Map with one value per cell.
GRIDS = ("survival", "low", "high", "error", "lost", "stalled", "unstable")


class Axis(NamedTuple):
    """One axis of a map: the dotted path of a quantity and its values, ascending. `log`: logarithmic spacing."""

    path: str
    values: np.ndarray
    log: bool = False


class Map(NamedTuple):
    """Results of a map. Arrays have one value per cell, [ny, nx].

    - `survival`, `low`, `high`: share of survivors, and the ends of its 95 % interval.
    - `error`: median over the survivors of the largest settled |z - r|, m; NaN in cells without a survivor.
    - `lost`: number of members whose rotor is lost.
    - `stalled`: number of members whose integration stopped early; `survival` counts them as not surviving.
    - `unstable`: 1 where member 0 of the cell is held, but its loop is not stable; else 0.
    - `members`: number of members in each cell.
    - `varied`: whether the members of a cell differ, by noise or by the case's spread.
    - `drawn`: dotted paths of the spread quantities that are not axes; empty for one member.
    """

    x: Axis
    y: Axis
    survival: np.ndarray
    low: np.ndarray
    high: np.ndarray
    error: np.ndarray
    lost: np.ndarray
    stalled: np.ndarray
    unstable: np.ndarray
    members: int
    varied: bool = True
    drawn: tuple[str, ...] = ()

    @property
    def decisive(self) -> bool:
        """Whether the members differ, and suffice to make a cell certain (CERTAIN) if all of them survive."""
        return self.varied and bool(wilson(self.members, self.members).low >= CERTAIN)

    @property
    def middle(self) -> int:
        """Index of the row whose y is nearest to the middle of the range of y."""
        return int(np.argmin(np.abs(self.y.values - (self.y.values[0] + self.y.values[-1]) / 2)))

    def reach(self) -> tuple[float, float] | None:
        """Return the ends of the longest run of x values at which all members survive, on the middle row, or None.

        Cells that are not stable are left out.
        """
        good = (self.survival[self.middle] == 1) & (self.unstable[self.middle] == 0)
        held = np.concatenate([[False], good, [False]])
        begin, end = np.flatnonzero(held[1:] & ~held[:-1]), np.flatnonzero(held[:-1] & ~held[1:]) - 1
        if not begin.size:
            return None
        longest = int(np.argmax(end - begin))
        return float(self.x.values[begin[longest]]), float(self.x.values[end[longest]])


# Returns whether each system of a study is stable, [N]. The other arguments are those of `AnyStudy.metrics`.
StabilityTest = Callable[[AnyStudy, Arrays, np.ndarray], np.ndarray]
# Returns the numbers that the controllers of cells are designed with, [N] by dotted path, from the values of the axes.
Design = Callable[[AnyStudy, Arrays], Arrays]


def grid(study: AnyStudy, x: Axis, y: Axis, stable: StabilityTest | None = None, design: Design | None = None) -> Map:
    """Compute a map with `study.members` members in every cell.

    An axis may be any number of `study.places()`, or clock.sample_period. All cells of one study run in one ensemble.
    Values that need a study of their own (`AnyStudy.rereads`) run one after the other, each for the duration of the
    case. Member k has the same noise
    in each cell. With one member the case is nominal: no spread, and the noise of member 0. With more members, the
    case's spread applies to all quantities that are not axes. `stable`: the test of member 0 of each cell; None:
    `unstable` is 0. `design`: of numbers that follow from the values of the axes; PERIOD is one of them.

    Raises ValueError for a path that does not exist, for two equal paths, and for values of an axis that a case of one
    axis does not allow.
    """
    if x.path == PERIOD:
        transpose = grid(study, y, x, stable, design)
        return transpose._replace(x=x, y=y, **{k: getattr(transpose, k).T for k in GRIDS})
    _check(study, x, y)
    rows = []
    for row, own in _studies(study, y):
        parts = [_cells(one, axis or x, own, stable, design) for one, axis in _studies(row, x)]
        rows.append([np.concatenate(part, axis=1) for part in zip(*parts, strict=True)])
    ended, stalled, error, unstable = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    survival = wilson(np.sum(~ended, axis=-1), study.members)
    held = ~ended.all(axis=-1)
    median = np.full(held.shape, np.nan)
    median[held] = np.nanmedian(np.where(ended, np.nan, error)[held], axis=-1)
    counts = np.sum(ended & ~stalled, axis=-1), np.sum(stalled, axis=-1)
    paths = tuple(path for path, _ in _entries(study, (x.path, y.path)))
    return Map(x, y, *survival, median, *counts, unstable, study.members, bool(paths) or study.random, paths)


def _studies(study: AnyStudy, axis: Axis) -> list[tuple[AnyStudy, Axis | None]]:
    """Return the studies for the values of an axis, each with its part of the axis; None: its sample period."""
    if not study.rereads(axis.path):
        return [(study, axis)]
    each = [(study.at(axis.path, float(value)), axis._replace(values=np.array([value]))) for value in axis.values]
    return [(one, None if axis.path == PERIOD else part) for one, part in each]


def with_method_for_axes(study: Study, x: Axis, y: Axis) -> Study:
    """Return the study with an integration method that is valid for all values of the axes.

    The method is replaced only if the case has a processor and the method is the automatic choice for the spread.
    Raises ValueError as `grid` does.
    """
    _check(study, x, y)
    cascade, scenario, clock = study.cascade, study.scenario, study.clock
    usual = choose_method(*corners(study.spread, cascade, scenario), float(clock.sample_period))
    if not cascade.sampled or clock.method != usual:
        return study
    axes = {axis.path: (float(axis.values[0]), float(axis.values[-1])) for axis in (x, y)}
    period = axes.pop(PERIOD, (clock.sample_period,))[-1]
    others = [entry for entry in study.spread.entries if entry[0] not in axes]
    wide = Spread((*others, *((path, Uniform(*reach)) for path, reach in axes.items())))
    method = choose_method(*ends(wide, cascade, scenario, STEP_PATHS), float(period))
    return dataclasses.replace(study, clock=clock.with_method(method))


def _entries(study: AnyStudy, axes: tuple[str, ...]) -> tuple[tuple[str, Distribution], ...]:
    """Return the entries of the study's spread that are not axes; none for one member."""
    parts = {part for path in axes for part in study.parts(path)}
    return tuple(entry for entry in study.spread.entries if entry[0] not in parts) if study.members > 1 else ()


def _check(study: AnyStudy, x: Axis, y: Axis) -> None:
    """Raise ValueError for an axis whose path or values the case does not allow, and for two equal paths."""
    known = [*study.places(), PERIOD]
    for name, axis in (("x", x), ("y", y)):
        if axis.path not in known:
            raise ValueError(f"--{name} {axis.path}: {no_such_number(axis.path, known)}")
    if x.path == y.path:
        raise ValueError(f"--y {y.path}: --x has the same quantity. Choose another.")
    if not isinstance(study, Study):
        return
    axes = {axis.path: (name, Choice(tuple(axis.values))) for name, axis in (("x", x), ("y", y)) if axis.path != PERIOD}
    entries = (*((path, values) for path, (_, values) in axes.items()), *_entries(study, (x.path, y.path)))
    try:
        check_spread(Spread(entries), study.cascade, study.scenario)
    except SpreadError as error:
        if error.path not in axes:
            raise
        name, values = axes[error.path]
        low, high = values.support(0.0)
        raise ValueError(f"--{name} {error.path}={low:g}:{high:g}: {error.reason}") from None


def _cells(
    study: AnyStudy, x: Axis, y: Axis | None, stable: StabilityTest | None, design: Design | None
) -> tuple[np.ndarray, ...]:
    """Return, for each member, whether it is lost or stalled, whether it is stalled, and its settled error, m.

    The settled error is the largest settled |z - r|. Each array has shape [ny, nx, members]. The last array, [ny, nx],
    is 1 where member 0 is held but not stable.
    """
    shape = (1 if y is None else len(y.values), len(x.values), study.members)
    member = np.broadcast_to(np.arange(study.members), shape).ravel()
    axes = {x.path: np.broadcast_to(x.values[None, :, None], shape).ravel()}
    if y is not None:
        axes[y.path] = np.broadcast_to(y.values[:, None, None], shape).ravel()
    spread = Spread(_entries(study, tuple(axes)), study.spread.design)
    values = drawn(spread, study.places(), study.seed, np.arange(study.members), study.members)
    values = {k: v[member] for k, v in values.items()}
    axes = {part: v for path, v in axes.items() for part in study.parts(path)}
    values |= axes
    if design is not None:
        own = {} if y is not None else {PERIOD: np.full(len(member), float(study.clock.sample_period))}
        values = design(study, axes | own) | values
    metrics = study.metrics(values, member)
    ended, stalled, error = np.isfinite(metrics["lost_at_s"]), metrics["stalled"], metrics["settled_max_abs_error_m"]
    unstable = np.zeros(shape[:2], bool).ravel()
    if stable is not None:
        unstable = ~stable(study, {k: v[:: study.members] for k, v in values.items()}, member[:: study.members])
    unstable = unstable & ~ended[:: study.members]
    grids = (np.reshape(part, shape) for part in (ended, stalled, error))
    return *grids, np.reshape(unstable, shape[:2]).astype(int)
