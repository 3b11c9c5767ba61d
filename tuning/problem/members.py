"""Members of an ensemble, and the objective, which maps gains and a member to the result of a fold."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.control.cascade import Cascade
from ambjax.control.synchronous_notch import NotchGain
from ambjax.ensemble import Spread, apply, draw
from ambjax.extend import Scalar, canonical
from ambjax.linear import linearisation_inputs
from ambjax.linear.notch_design import redesigned
from ambjax.linear.quiet_run import calmed
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import prepare, rolled_in_parts, rollout
from ambjax.world.scenario import Scenario
from tuning.problem.loss import Loss
from tuning.problem.quantities import LOOPS
from tuning.problem.space import Space

# Number of members, or of finalists of a race, that are simulated where more would take too long: with accurate steps,
# with injections, and of a machine in its search. The screen simulates one member in FEW, but at least FEW ordinary and
# FEW stressed members.
FEW = 4


class LoopRange(NamedTuple):
    """Names of the limited quantities of linearised loops, and the arguments of `loop_quantities` besides the loop."""

    names: tuple[str, ...]
    low: float
    pole: float
    volts_per_metre: float


class Members(NamedTuple):
    """Members of an ensemble.

    `member` [n]: their numbers. `seed` [n]: of their ensembles. `values`: the spread values [n] by path.
    `noise_factor` [n]: factor on the sensor noise. `shift` [n, m]: offset of the coordinates of the gains.
    `stressed` [n]: whether only clearance and survival count for a member (`weigh`); stressed members come last.
    `quiet` [n]: 1 for members that make a quiet run (`linear.quiet_run.calmed`), else 0.
    """

    member: Any
    seed: Any
    values: dict[str, Any]
    noise_factor: Any
    shift: Any
    stressed: Any
    quiet: Any

    @property
    def ordinary(self) -> int:
        """The number of members that are not stressed."""
        return int(np.sum(~self.stressed))

    @property
    def searched(self) -> "Members":
        """The members whose linearised loops the search evaluates: the first LOOPS that are not stressed."""
        return jax.tree.map(lambda a: a[: min(self.ordinary, LOOPS)], self)

    def joined(self, others: "Members", stressed: bool = True) -> "Members":
        """Return these members with `others`, which become stressed or, in front of all members, ordinary.

        In front, they are in the screen, and among the members whose loops the search evaluates.
        """
        more, n = others._replace(stressed=np.full(len(others.stressed), stressed)), self.ordinary * stressed
        return jax.tree.map(lambda a, b: np.concatenate([a[:n], b, a[n:]]), self, more)

    @property
    def part(self) -> "Members":
        """The first 1/FEW of the ordinary and of the stressed members, at least FEW of each kind."""
        return self._first(*(max(count // FEW, min(FEW, count)) for count in self._kinds))

    @property
    def pair(self) -> "Members":
        """The first member of each kind."""
        return self._first(*(min(count, 1) for count in self._kinds))

    @property
    def _kinds(self) -> tuple[int, int]:
        """The numbers of ordinary and of stressed members."""
        return self.ordinary, len(self.stressed) - self.ordinary

    def _first(self, ordinary: int, stressed: int) -> "Members":
        index = np.concatenate([np.arange(ordinary), np.arange(self.ordinary, self.ordinary + stressed)])
        return jax.tree.map(lambda a: a[index], self)


@dataclasses.dataclass(frozen=True)
class Objective:
    """The gains to tune, the simulated world and the loss: the part of a problem that is compiled.

    `loop`: the analysis of the linearised loops; None: no limit needs it.
    """

    space: Space
    cascade: Cascade
    scenario: Scenario
    clock: Clock
    loss: Loss
    spread: Spread = Spread()
    loop: LoopRange | None = None

    def members(self, seed: int, count: int) -> Members:
        """Return the first `count` members of the ensemble with this seed."""
        return self.chosen(seed, np.arange(count), count)

    def training(self, seed: int, count: int, extra: int, noise: float, gains: float) -> Members:
        """Return `count` ordinary and `extra` stressed members.

        A stressed member has `noise` times the sensor noise, and each of its gains is multiplied or divided by
        `gains`. All gains of the first stressed member are multiplied, all of the second are divided. For each gain of
        the others, a random number from the seed decides.
        """
        members = self.members(seed, count + extra)
        stressed = members.member >= count
        sign = np.random.default_rng(seed).choice([-1.0, 1.0], (count + extra, len(self.space)))
        sign[count : count + 2] = np.array([[1.0], [-1.0]])[:extra]
        shift = np.log(gains) * np.where(stressed[:, None], sign, 0.0)
        return members._replace(noise_factor=np.where(stressed, noise, 1.0), shift=shift, stressed=stressed)

    def chosen(self, seed: int, numbers: np.ndarray, total: int) -> Members:
        """Return the members with these numbers [n] of an ensemble of `total` members."""
        values = draw(self.spread, self.cascade, self.scenario, seed, numbers, total) if self.spread.entries else {}
        n = len(numbers)
        still = np.zeros((n, len(self.space)))
        return Members(numbers, np.full(n, seed), values, np.ones(n), still, np.zeros(n, bool), np.zeros(n))

    def world(self, members: Members) -> tuple[Cascade, Scenario]:
        """Return the cascade and the scenario of one member with scalar fields. The gains are the case's."""
        scenario = dataclasses.replace(self.scenario, member=members.member, seed=members.seed)
        cascade, scenario = (
            apply(self.cascade, scenario, members.values) if members.values else (self.cascade, scenario)
        )
        return cascade, calmed(scenario.louder(members.noise_factor), members.quiet)

    def notched(self, x: np.ndarray, cascade: Cascade) -> Cascade:
        """Return a cascade with the notch designed for the gains at coordinates x [m], or for those at each x [S, m].

        A notch has the gains of the nominal case, for every member. A cascade without a notch is returned as it is.
        """
        if cascade.notch is None:
            return cascade
        loop = linearisation_inputs(self.cascade, self.scenario, self.clock)
        x = np.asarray(x, jnp.result_type(float))
        rows, place = np.unique(x.reshape(-1, x.shape[-1]), axis=0, return_inverse=True)  # the members share a start
        gains = _designs(*canonical((rows, *loop)), space=self.space)
        gains = jax.tree.map(lambda a: np.asarray(a)[place.reshape(x.shape[:-1])], gains)
        return dataclasses.replace(cascade, notch=dataclasses.replace(cascade.notch, gains=gains))

    def fixed(self, x: np.ndarray, members: Members) -> tuple[Cascade, Scenario]:
        """Return the cascade with the gains at x [m] and the scenario of members [n]. Varying leaves are arrays [n]."""
        seed = members.seed if np.ptp(members.seed) else int(members.seed[0])
        scenario = dataclasses.replace(self.scenario, member=np.asarray(members.member), seed=seed)
        cascade, scenario = apply(self.cascade, scenario, members.values)
        at = (x + members.shift).T if np.any(members.shift) else x  # [m] or [m, n]
        cascade = self.notched(x, self.space.decode(jnp.asarray(at), cascade))
        if np.any(members.quiet):
            scenario = calmed(scenario, members.quiet)
        return cascade, scenario.louder(members.noise_factor) if np.any(members.noise_factor != 1) else scenario

    def run(self, x: Array, members: Members, fold: Any, *, in_parts: bool = False) -> Any:
        """Return the fold's result for the rollout of one member at coordinates x [m].

        `in_parts`: recompute parts of the run in reverse mode, which saves memory (`rolled_in_parts`).
        """
        cascade, scenario = self.world(members)
        cascade = self.space.decode(x + members.shift, cascade)
        if in_parts:
            return rolled_in_parts(*prepare(cascade, scenario, self.clock), fold).metrics
        return rollout(cascade, scenario, self.clock, fold=fold, record_every=0).metrics


@partial(compiled_quickest, static_argnames=("space",))
def _designs(x: Array, cascade: Cascade, scenario: Scenario, period: Scalar, *, space: Space) -> tuple[NotchGain, ...]:
    """Return the gains of the notch at each x [S, m]; the leaves are arrays [S]."""
    return jax.vmap(lambda x: redesigned(space.decode(x, cascade), scenario, period))(x)
