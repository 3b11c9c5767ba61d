"""Maps: survival and error over a grid of two quantities, each cell a small ensemble."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import run_ensemble
from ambjax.ensemble.distributions import Choice, Distribution, Uniform
from ambjax.ensemble.intervals import wilson
from ambjax.ensemble.paths import places
from ambjax.ensemble.spread import STEP, Spread, apply, check_spread, corners, ends, require_path
from ambjax.ensemble.study import Study
from ambjax.simulation.method import choose_method
from ambjax.simulation.metrics import standard_for
from ambjax.world.scenario import Scenario

PERIOD = "clock.sample_period"
# A cell is sure of its survival where the lower end of its interval is at least this share.
SURE = 0.95
# Fields of a Map by cell.
GRIDS = ("survival", "low", "high", "error", "lost", "stalled")


class Axis(NamedTuple):
    """One quantity of a map: its dotted path and its values, ascending; `log` if they are spaced so."""

    path: str
    values: np.ndarray
    log: bool = False


class Map(NamedTuple):
    """Results by cell [ny, nx]: share of survivors with its 95 % interval, and the median settled |z - r|, m.

    The error is NaN where no member of the cell survives. `lost` and `stalled` count the members that do not survive:
    of the latter the integrator gave up, and their status is not known. `members`: runs of each cell. `varied`: whether
    they differ, by noise or by what was spread. `drawn`: dotted paths of the latter.
    """

    x: Axis
    y: Axis
    survival: np.ndarray
    low: np.ndarray
    high: np.ndarray
    error: np.ndarray
    lost: np.ndarray
    stalled: np.ndarray
    members: int
    varied: bool = True
    drawn: tuple[str, ...] = ()

    @property
    def decisive(self) -> bool:
        """Whether members differ, and a cell has enough of them for its interval to lie above SURE if all survive."""
        return self.varied and bool(wilson(self.members, self.members).low >= SURE)

    @property
    def middle(self) -> int:
        """Number of the row of y nearest the middle of its range."""
        return int(np.argmin(np.abs(self.y.values - (self.y.values[0] + self.y.values[-1]) / 2)))

    def reach(self) -> tuple[float, float] | None:
        """Ends of the longest unbroken stretch of x in which all members survive, on the middle row of y."""
        held = np.concatenate([[False], self.survival[self.middle] == 1, [False]])
        begin, end = np.flatnonzero(held[1:] & ~held[:-1]), np.flatnonzero(held[:-1] & ~held[1:]) - 1
        if not begin.size:
            return None
        longest = int(np.argmax(end - begin))
        return float(self.x.values[begin[longest]]), float(self.x.values[end[longest]])


def grid(study: Study, x: Axis, y: Axis) -> Map:
    """`study.members` members in every cell, all cells in one ensemble; member k has the same noise in each.

    The axes may be any numbers of the case, or clock.sample_period: its values are run one after the other, each with
    as many samples as the case's duration has of them. With one member the case is nominal: nothing is spread, and the
    noise is that of member 0. With more, the case's own spread applies to all quantities that are no axis.

    Raises ValueError for a path that does not exist.
    """
    if x.path == PERIOD:
        transpose = grid(study, y, x)
        return transpose._replace(x=x, y=y, **{k: getattr(transpose, k).T for k in GRIDS})
    _check(study, x, y)
    rows = [_cells(study, x, y)] if y.path != PERIOD else [_cells(_at_period(study, p), x, None) for p in y.values]
    ended, stalled, error = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    survival = wilson(np.sum(~ended, axis=-1), study.members)
    held = ~ended.all(axis=-1)
    median = np.full(held.shape, np.nan)
    median[held] = np.nanmedian(np.where(ended, np.nan, error)[held], axis=-1)
    counts = np.sum(ended & ~stalled, axis=-1), np.sum(stalled, axis=-1)
    paths = tuple(path for path, _ in _entries(study, (x.path, y.path)))
    return Map(
        x,
        y,
        survival.value,
        survival.low,
        survival.high,
        median,
        *counts,
        study.members,
        bool(paths) or study.scenario.random,
        paths,
    )


def stepped(study: Study, x: Axis, y: Axis) -> Study:
    """On a processor, the study with its method chosen for the axes' ends too, if it was chosen for its spread's.

    Raises ValueError for a path that does not exist.
    """
    _check(study, x, y)
    cascade, scenario, clock = study.cascade, study.scenario, study.clock
    usual = choose_method(*corners(study.spread, cascade, scenario), float(clock.sample_period))
    if cascade.processor is None or clock.method != usual:
        return study
    axes = {axis.path: (float(axis.values[0]), float(axis.values[-1])) for axis in (x, y)}
    period = axes.pop(PERIOD, (clock.sample_period,))[-1]
    others = [entry for entry in study.spread.entries if entry[0] not in axes]
    wide = Spread((*others, *((path, Uniform(*reach)) for path, reach in axes.items())))
    method = choose_method(*ends(wide, cascade, scenario, STEP), float(period))
    return dataclasses.replace(study, clock=dataclasses.replace(clock, method=method))


def _entries(study: Study, axes: tuple[str, ...]) -> tuple[tuple[str, Distribution], ...]:
    """What is spread: nothing for one member."""
    return tuple(entry for entry in study.spread.entries if entry[0] not in axes) if study.members > 1 else ()


def _check(study: Study, x: Axis, y: Axis) -> None:
    """Raise ValueError for axes that the case lacks, or that as spreads it would refuse."""
    known = [*places(study.cascade, study.scenario), PERIOD]
    for name, axis in (("x", x), ("y", y)):
        if axis.path not in known:
            try:
                require_path(axis.path, known)
            except ValueError as error:
                raise ValueError(str(error).replace("spread.", f"--{name} ", 1)) from None
    if x.path == y.path:
        raise ValueError(f"--y {y.path}: it is the quantity of --x too. Choose another.")
    axes = {axis.path: (name, Choice(tuple(axis.values))) for name, axis in (("x", x), ("y", y)) if axis.path != PERIOD}
    entries = (*((path, values) for path, (_, values) in axes.items()), *_entries(study, (x.path, y.path)))
    try:
        check_spread(Spread(entries), study.cascade, study.scenario)
    except ValueError as error:
        words = str(error)
        for path, (name, values) in axes.items():
            low, high = values.support(0.0)
            words = words.replace(f"spread.{path} = {values}", f"--{name} {path}={low:g}:{high:g}", 1)
        raise ValueError(words.replace("Narrow the spread", "Narrow it")) from None


def _at_period(study: Study, period: float) -> Study:
    samples = max(round(float(study.clock.duration) / period), 1)
    return dataclasses.replace(study, clock=dataclasses.replace(study.clock, samples=samples, sample_period=period))


def _cells(study: Study, x: Axis, y: Axis | None) -> tuple[np.ndarray, ...]:
    """Whether lost or stalled, whether stalled, and largest settled |z - r|: [ny, nx, members]."""
    shape = (1 if y is None else len(y.values), len(x.values), study.members)
    member = np.broadcast_to(np.arange(study.members), shape).ravel()
    axes = {x.path: np.broadcast_to(x.values[None, :, None], shape).ravel()}
    if y is not None:
        axes[y.path] = np.broadcast_to(y.values[:, None, None], shape).ravel()
    entries = _entries(study, tuple(axes))
    values = dataclasses.replace(study, spread=Spread(entries, study.spread.design)).drawn(np.arange(study.members))
    cascade, scenario = _batch(study.cascade, study.scenario, {k: v[member] for k, v in values.items()} | axes)
    scenario = dataclasses.replace(scenario, seed=study.seed, member=member)
    metrics = run_ensemble(cascade, scenario, study.clock, fold=standard_for(study.settle, scenario)).measured
    ended, stalled, error = np.isfinite(metrics["lost_at_s"]), metrics["stalled"], metrics["settled_max_abs_error_m"]
    return tuple(np.reshape(part, shape) for part in (ended, stalled, error))


def _batch(cascade: Cascade, scenario: Scenario, values: dict[str, np.ndarray]) -> tuple[Cascade, Scenario]:
    return jax.tree.map(np.asarray, apply(cascade, scenario, values))
