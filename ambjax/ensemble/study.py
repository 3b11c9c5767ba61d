"""A study: one case, how it is spread, a seed and a number of members; any part of it can be run anywhere."""

import dataclasses
import math
import shlex
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import run_ensemble
from ambjax.ensemble.blocks import Blocks
from ambjax.ensemble.paths import kinds, places
from ambjax.ensemble.spread import Spread, apply, draw
from ambjax.host.sealed import provenance
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import standard_for
from ambjax.simulation.trajectory import Trajectory
from ambjax.world.scenario import Scenario

SPREAD = "spread."
# Columns of members.npz beside the spread quantities, at most: to estimate what a study needs on disk.
COLUMNS = 28
# Parts of a run over each of which the voltage's variation is one number.
WINDOWS = 25
# Signals of a fan chart, and the fields of a Row that they are.
SHOWN = {"z - r": "e_z", "u": "u_mean", "sigma": "sigma"}


class Bands(NamedTuple):
    """What a fan chart shows of some members: instants t [T] (s), trajectories, and signals by name [members, T].

    Signals are NaN from the instant on at which a member is lost. "variation of u" is its total variation per second,
    V/s, in each of WINDOWS equal parts of the run; NaN from the part on in which a member is lost. `extremes`: for each
    other signal the smallest and the largest value, each [T], that any member alive has at a sample between the
    instant before and the instant after; NaN where there is none.
    """

    t: np.ndarray
    trajectory: Trajectory
    signals: dict[str, np.ndarray]
    extremes: dict[str, tuple[np.ndarray, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Study:
    """What an ensemble is. Member k depends on (seed, k) and, in a Latin hypercube, on `members`.

    `clock.method` must hold for every member (a case file's does: it is chosen for the spread's extremes).
    """

    cascade: Cascade
    scenario: Scenario
    clock: Clock
    settle: float
    spread: Spread
    seed: int
    members: int

    @property
    def varies(self) -> bool:
        """Whether two members differ."""
        return bool(self.spread.entries) or self.scenario.random

    def drawn(self, members: np.ndarray) -> dict[str, np.ndarray]:
        """The spread quantities of these members (integers [n]) by dotted path, [n] each."""
        return draw(self.spread, self.cascade, self.scenario, self.seed, members, self.members)

    def batch(self, members: np.ndarray) -> tuple[Cascade, Scenario]:
        """The cascade and scenario of these members (integers [n]), leaves that vary [n]."""
        cascade, scenario = apply(self.cascade, self.scenario, self.drawn(members))
        return cascade, dataclasses.replace(scenario, seed=self.seed, member=members)

    def member(self, index: int) -> tuple[Cascade, Scenario]:
        """Cascade and scenario of one member, leaves numbers."""
        values = {path: float(x[0]) for path, x in self.drawn(np.array([index])).items()}
        cascade, scenario = apply(self.cascade, self.scenario, values)
        return cascade, dataclasses.replace(scenario, seed=self.seed, member=index)

    def command(self, case: str, index: int) -> str:
        """The command that simulates one member by itself; `case` is the path of the case file."""
        words = ["ambjax", "simulate", case]
        if self.varies:
            words += ["--member", str(index), "--seed", str(self.seed)]
        if self.spread.design == "latin-hypercube":
            words += ["--members", str(self.members)]
        return shlex.join(words)

    def columns(
        self, start: int, stop: int, *, call: int | None = None, threads: int | None = None, lost: bool = False
    ) -> dict[str, Any]:
        """Members start <= k < stop, one row each: index, lost_at, every metric, and spread.PATH. [stop - start].

        `lost`: every rotor is lost where it starts; that compiles the very program, and costs little more.
        """
        members = np.arange(start, stop)
        cascade, scenario = self.batch(members)
        if lost:
            far = np.full(np.shape(scenario.initial.z), 2 * np.max(np.asarray(scenario.touchdown)))
            scenario = dataclasses.replace(scenario, initial=dataclasses.replace(scenario.initial, z=far))
        fold = standard_for(self.settle, scenario)
        outcome = run_ensemble(cascade, scenario, self.clock, fold=fold, threads=threads, call=call)
        values = {SPREAD + path: x for path, x in self.drawn(members).items()}
        return {"index": members, "lost_at": outcome.trajectory.lost_at, **outcome.measured, **values}

    def bands(self, members: int, times: int, until: float = math.inf) -> Bands:
        """What a fan chart shows of the first `members` members, up to the time `until` (s) or the end of the run.

        Instants: every so many samples that there are at most `times` of them, and the last sample.
        """
        period = float(self.clock.sample_period)
        samples = int(min(self.clock.samples, math.ceil(until / period) + 1 if math.isfinite(until) else math.inf))
        every = -(-samples // times)
        count = -(-samples // every)
        cascade, scenario = self.batch(np.arange(min(members, self.members)))
        fold = Blocks(tuple(SHOWN.values()), every, count, period)
        clock = dataclasses.replace(self.clock, samples=samples)
        outcome = run_ensemble(cascade, scenario, clock, fold=fold, every=every)
        rows, folded = outcome.trajectory.rows, outcome.measured
        # the last instant too, unless it is that of the last block
        ends = [(samples - 1) * period] if (samples - 1) % every else []
        t = np.append(np.asarray(rows.t[0]), ends)
        signals, extremes = {}, {}
        for name, of in SHOWN.items():
            values = np.where(rows.alive, getattr(rows, of), np.nan)
            signals[name] = np.concatenate([values, folded.last[of][:, None][:, : len(ends)]], axis=1)
            low, high = folded.low[of].min(axis=0), folded.high[of].max(axis=0)
            extremes[name] = _beside(low, np.fmin, len(t)), _beside(high, np.fmax, len(t))
        starts = np.arange(min(WINDOWS, count)) * count // min(WINDOWS, count)
        edges = period * np.append(every * starts, samples)
        rate = np.add.reduceat(folded.variation, starts, axis=1) / np.diff(edges)
        rate[edges[1:] > np.asarray(outcome.trajectory.lost_at)[:, None]] = np.nan
        part = np.searchsorted(starts, np.minimum(np.arange(len(t)), count - 1), side="right") - 1
        return Bands(t, outcome.trajectory, signals | {"variation of u": rate[:, part]}, extremes)

    def fingerprint(self) -> dict[str, Any]:
        """Everything that a member's numbers depend on, by name, as JSON has it."""
        facts: dict[str, Any] = {**provenance(), "members": self.members, "seed": self.seed}
        facts |= {**dict(kinds(self.cascade, "controller.")), **dict(kinds(self.scenario))}
        facts |= {path: str(place.value) for path, place in places(self.cascade, self.scenario).items()}
        facts |= {"clock.samples": self.clock.samples, "clock.sample_period": str(self.clock.sample_period)}
        facts |= {"clock.method": str(self.clock.method), "run.settle": self.settle}
        facts |= {"spread.design": self.spread.design}
        return facts | {SPREAD + path: repr(kind) for path, kind in self.spread.entries}


def _beside(blocks: np.ndarray, combine: Callable[[np.ndarray, np.ndarray], np.ndarray], instants: int) -> np.ndarray:
    """[instants] of what each block has [count]: at an instant, of the blocks that end and begin there; NaN: none."""
    values = np.where(np.isfinite(blocks), blocks, np.nan)
    padded = np.concatenate([[np.nan], values, [np.nan]])
    return combine(padded[:-1], padded[1:])[:instants]
