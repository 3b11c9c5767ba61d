"""A study: a case, its spread, a seed and a number of members. Its members can run in any order, on any machine."""

import abc
import dataclasses
import math
import shlex
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import run_ensemble
from ambjax.ensemble.blocks import Blocks
from ambjax.ensemble.paths import Place, kinds, places
from ambjax.ensemble.spread import Spread, apply, draw
from ambjax.host.sealed import Arrays, provenance
from ambjax.numerics.records import replaced
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.trajectory import Trajectory
from ambjax.world.scenario import Scenario

# Path of the sample period, which a map may vary.
PERIOD = "clock.sample_period"

SPREAD = "spread."
# Largest number of columns of members.npz besides those of the spread, to estimate the disk space of a study.
COLUMNS = 34
# The variation of the voltage in a fan chart is that of the last one of this many parts of its time.
WINDOWS = 25
# Signals of a fan chart, and the corresponding fields of a Row.
FAN_SIGNALS = {"z - r": "e_z", "u": "u_mean", "sigma": "sigma"}


class Bands(NamedTuple):
    """The data of a fan chart.

    - `t`: instants [T], s.
    - `trajectory`: trajectories of the members.
    - `signals`: signals by name [members, T]; NaN from the instant at which a member is lost. "variation of u" is the
      total variation of `u_mean` per second, V/s, over the time before each instant, a share 1/WINDOWS of the time
      shown; NaN at the instants before the end of the first such time.
    - `extremes`: for each other signal, the minimum and the maximum, each [T], over the members that are alive and over
      the samples between the previous and the next instant; NaN if there is no such sample.
    """

    t: np.ndarray
    trajectory: Trajectory
    signals: Arrays
    extremes: dict[str, tuple[np.ndarray, np.ndarray]]


class AnyStudy(abc.ABC):
    """A study of one axis or of a machine: `Study`, whose attributes have the same meaning, or `MachineStudy`."""

    clock: Clock
    settle: float
    spread: Spread
    seed: int
    members: int

    @property
    @abc.abstractmethod
    def random(self) -> bool:
        """Whether the members have random signals of their own."""

    @property
    def varies(self) -> bool:
        return bool(self.spread.entries) or self.random

    @abc.abstractmethod
    def drawn(self, members: np.ndarray) -> Arrays:
        """Draw the spread quantities of these members (integers [n]); arrays [n] by dotted path."""

    @abc.abstractmethod
    def places(self) -> dict[str, Place]:
        """Return the numbers that an axis of a map may vary, by dotted path."""

    def parts(self, path: str) -> tuple[str, ...]:
        """Return the paths of the numbers that a path of `places` stands for: itself, or those of several axes."""
        return (path,)

    def rereads(self, path: str) -> bool:
        """Return whether each value of this number needs a study of its own (`at`)."""
        return path == PERIOD

    @abc.abstractmethod
    def at(self, path: str, value: float) -> Self:
        """Return the study with another value of a number for which `rereads` is true; runs have the same duration."""

    @abc.abstractmethod
    def metrics(self, values: Arrays, members: np.ndarray, *, lost: bool = False, **how: Any) -> Arrays:
        """Simulate systems with these values [n] by dotted path, and return lost_at (s) and their metrics, [n] by name.

        `members` [n]: numbers of the members whose random signals they have. `lost` and, in `how`, `call`
        and `threads` are those of `columns`.
        """

    def columns(
        self, start: int, stop: int, *, call: int | None = None, threads: int | None = None, lost: bool = False
    ) -> dict[str, Any]:
        """Simulate members start <= k < stop and return their columns, each [stop - start], by name.

        The columns are index, lost_at (s), every metric, and spread.PATH for each spread quantity. `call` and `threads`
        are those of `map_members`. `lost`: start every rotor outside its clearance, so that it is lost at once. Such a
        call compiles the program of the study without the cost of a run.
        """
        members = np.arange(start, stop)
        values = self.drawn(members)
        metrics = self.metrics(values, members, lost=lost, call=call, threads=threads)
        return {"index": members, **metrics, **{SPREAD + path: x for path, x in values.items()}}

    def facts(self) -> dict[str, object]:
        """Return the part of the fingerprint that does not describe the system."""
        facts: dict[str, object] = {**provenance(), "members": self.members, "seed": self.seed}
        facts |= {"clock.samples": self.clock.samples, "clock.sample_period": str(self.clock.sample_period)}
        facts |= {"clock.method": str(self.clock.method), "run.settle": self.settle}
        facts |= {"spread.design": self.spread.design}
        return facts | {SPREAD + path: repr(kind) for path, kind in self.spread.entries}

    @abc.abstractmethod
    def fingerprint(self) -> dict[str, object]:
        """Return everything that determines the results of the study, by name, as values that JSON can hold."""

    def command(self, case: str, index: int) -> str:
        """Return the command line that simulates one member alone; `case` is the path of the case file."""
        words = ["ambjax", "simulate", case]
        if self.varies:
            words += ["--member", str(index), "--seed", str(self.seed)]
        if self.spread.design == "latin-hypercube":
            words += ["--members", str(self.members)]
        return shlex.join(words)


@dataclasses.dataclass(frozen=True)
class Study(AnyStudy):
    """The definition of an ensemble. Member k depends on (seed, k) and, in a Latin hypercube, on `members`.

    - `clock`: its method must be valid for every member. `cases.reader` chooses it for the extremes of the spread.
    - `settle`: time from which "settled" metrics count, s.
    - `seed`: seed of the spread and of the noise.
    - `members`: number of members.
    """

    cascade: Cascade
    scenario: Scenario
    clock: Clock
    settle: float
    spread: Spread
    seed: int
    members: int

    @property
    def random(self) -> bool:
        return self.scenario.random

    def drawn(self, members: np.ndarray) -> Arrays:
        return draw(self.spread, self.cascade, self.scenario, self.seed, members, self.members)

    def batch(self, members: np.ndarray) -> tuple[Cascade, Scenario]:
        """Return the cascade and scenario of these members (integers [n]); leaves that vary are arrays [n]."""
        return self.varied(self.drawn(members), members)

    def varied(self, values: Arrays, members: np.ndarray) -> tuple[Cascade, Scenario]:
        """Return the cascade and scenario with these values [n], and with the random signals of these members [n]."""
        cascade, scenario = apply(self.cascade, self.scenario, values)
        return cascade, dataclasses.replace(scenario, seed=self.seed, member=members)

    def places(self) -> dict[str, Place]:
        return places(self.cascade, self.scenario)

    def at(self, path: str, value: float) -> Self:
        assert path == PERIOD
        samples = max(round(float(self.clock.duration) / value), 1)
        return dataclasses.replace(self, clock=replaced(self.clock, samples=samples, sample_period=value))

    def metrics(self, values: Arrays, members: np.ndarray, *, lost: bool = False, **how: Any) -> Arrays:
        cascade, scenario = self.varied(values, members)
        if lost:
            far = np.full(np.shape(scenario.initial.z), 2 * np.max(np.asarray(scenario.limit)))
            scenario = dataclasses.replace(scenario, initial=dataclasses.replace(scenario.initial, z=far))
        fold = Metrics.of(self.settle, scenario)
        outcome = run_ensemble(cascade, scenario, self.clock, fold=fold, **how)
        return {"lost_at": np.asarray(outcome.trajectory.lost_at), **outcome.metrics}

    def member(self, index: int) -> tuple[Cascade, Scenario]:
        """Return the cascade and scenario of one member; all leaves are numbers."""
        values = {path: float(x[0]) for path, x in self.drawn(np.array([index])).items()}
        cascade, scenario = apply(self.cascade, self.scenario, values)
        return cascade, dataclasses.replace(scenario, seed=self.seed, member=index)

    def bands(self, members: int, times: int, until: float = math.inf) -> Bands:
        """Compute the data of a fan chart of the first `members` members, up to time `until` (s) or the end."""
        period = float(self.clock.sample_period)
        samples = int(min(self.clock.samples, math.ceil(until / period) + 1 if math.isfinite(until) else math.inf))
        every = -(-samples // times)
        count = -(-samples // every)
        cascade, scenario = self.batch(np.arange(min(members, self.members)))
        fold = Blocks(tuple(FAN_SIGNALS.values()), every, count, period)
        clock = replaced(self.clock, samples=samples)
        outcome = run_ensemble(cascade, scenario, clock, fold=fold, record_every=every)
        rows, folded = outcome.trajectory.rows, outcome.metrics
        # Add the last sample, unless the last block begins there.
        ends = [(samples - 1) * period] if (samples - 1) % every else []
        t = np.append(np.asarray(rows.t[0]), ends)
        signals, extremes = {}, {}
        for name, of in FAN_SIGNALS.items():
            values = np.where(rows.alive, getattr(rows, of), np.nan)
            signals[name] = np.concatenate([values, folded.last[of][:, None][:, : len(ends)]], axis=1)
            low, high = folded.low[of].min(axis=0), folded.high[of].max(axis=0)
            extremes[name] = _beside(low, np.fmin, len(t)), _beside(high, np.fmax, len(t))
        rate = _rate(folded.variation, t, -(-count // WINDOWS))
        rate[np.isnan(signals["u"])] = np.nan
        return Bands(t, outcome.trajectory, signals | {"variation of u": rate}, extremes)

    def fingerprint(self) -> dict[str, object]:
        facts = self.facts()
        facts |= {**dict(kinds(self.cascade, "controller.")), **dict(kinds(self.scenario))}
        facts |= {path: str(place.value) for path, place in places(self.cascade, self.scenario).items()}
        return facts


def _beside(blocks: np.ndarray, combine: Callable[[np.ndarray, np.ndarray], np.ndarray], instants: int) -> np.ndarray:
    """Combine the values [count] of the two blocks that meet at each instant; NaN if neither is finite."""
    values = np.where(np.isfinite(blocks), blocks, np.nan)
    padded = np.concatenate([[np.nan], values, [np.nan]])
    return combine(padded[:-1], padded[1:])[:instants]


def _rate(increments: np.ndarray, t: np.ndarray, width: int) -> np.ndarray:
    """Return the mean rate of growth over the `width` blocks before each instant t [T]; NaN before all have passed."""
    total = np.concatenate([np.zeros((len(increments), 1)), np.cumsum(increments, axis=1)], axis=1)[:, : len(t)]
    rate = np.full(total.shape, np.nan)
    rate[:, width:] = (total[:, width:] - total[:, :-width]) / (t[width:] - t[:-width])
    return rate
