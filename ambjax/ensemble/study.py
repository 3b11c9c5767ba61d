"""A study: one case, how it is spread, a seed and a number of members; any part of it can be run anywhere."""

import dataclasses
from typing import Any

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.engine import run_ensemble
from ambjax.ensemble.paths import kinds, places
from ambjax.ensemble.spread import Spread, apply, draw
from ambjax.host.sealed import provenance
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import Named, Variation, standard_for
from ambjax.simulation.trajectory import Trajectory
from ambjax.world.scenario import Scenario

SPREAD = "spread."
# Columns of members.npz beside the spread quantities, at most: to estimate what a study needs on disk.
COLUMNS = 28
# Parts of a run over which the chatter of the voltage is told.
WINDOWS = 25


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

    def drawn(self, members: np.ndarray) -> dict[str, np.ndarray]:
        """The spread quantities of these members (integers [n]) by dotted path, [n] each."""
        return draw(self.spread, self.cascade, self.scenario, self.seed, members, self.members)

    def batch(self, members: np.ndarray) -> tuple[Cascade, Scenario]:
        """The cascade and scenario of these members (integers [n]), leaves that vary [n]."""
        cascade, scenario = apply(self.cascade, self.scenario, self.drawn(members))
        return cascade, dataclasses.replace(scenario, seed=self.seed, member=members)

    def member(self, index: int) -> tuple[Cascade, Scenario]:
        """One member alone, leaves numbers: what `ambjax simulate --member` runs."""
        values = {path: float(x[0]) for path, x in self.drawn(np.array([index])).items()}
        cascade, scenario = apply(self.cascade, self.scenario, values)
        return cascade, dataclasses.replace(scenario, seed=self.seed, member=index)

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

    def bands(self, members: int, times: int) -> tuple[np.ndarray, Trajectory, dict[str, np.ndarray]]:
        """Times [t], trajectories and signals [n, t] of the first `members` members, at most some `times` instants.

        Signals are NaN from the instant on at which a member is lost. "variation of u" is its total variation per
        second, V/s, in each of WINDOWS equal parts of the run; NaN from the part on in which a member is lost.
        """
        cascade, scenario = self.batch(np.arange(min(members, self.members)))
        every = -(-self.clock.samples // times)
        # whole samples, and half a sample before each: a time may be rounded
        samples, period = self.clock.samples, float(self.clock.sample_period)
        ends = period * np.linspace(0, samples, min(WINDOWS, samples) + 1).round()
        fold = Named({str(k): Variation(after) for k, after in enumerate(ends[:-1] - period / 2)})
        outcome = run_ensemble(cascade, scenario, self.clock, fold=fold, every=every)
        rows, t = outcome.trajectory.rows, np.asarray(outcome.trajectory.rows.t[0])
        curves = {"z - r": rows.z - rows.r, "u": rows.u_mean, "sigma": rows.sigma}
        signals = {k: np.where(rows.alive, x, np.nan) for k, x in curves.items()}
        later = [outcome.measured[str(k)] for k in range(len(ends) - 1)]
        left = np.stack([*later, np.zeros(len(rows.z))], axis=1)  # from each end on
        rate = -np.diff(left, axis=1) / np.diff(ends)
        rate[ends[1:] > np.asarray(outcome.trajectory.lost_at)[:, None]] = np.nan
        part = np.clip(np.searchsorted(ends - period / 2, t, side="right") - 1, 0, len(ends) - 2)
        return t, outcome.trajectory, signals | {"variation of u": rate[:, part]}

    def fingerprint(self) -> dict[str, Any]:
        """Everything that a member's numbers depend on, by name, as JSON has it."""
        facts: dict[str, Any] = {**provenance(), "members": self.members, "seed": self.seed}
        facts |= {**dict(kinds(self.cascade, "controller.")), **dict(kinds(self.scenario))}
        facts |= {path: str(place.value) for path, place in places(self.cascade, self.scenario).items()}
        facts |= {"clock.samples": self.clock.samples, "clock.sample_period": str(self.clock.sample_period)}
        facts |= {"clock.method": str(self.clock.method), "run.settle": self.settle}
        facts |= {"spread.design": self.spread.design}
        return facts | {SPREAD + path: repr(kind) for path, kind in self.spread.entries}
