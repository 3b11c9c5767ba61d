"""The engine: an objective and its derivatives for many gains and members at once, with common random numbers.

The work is cut into lanes: one rollout of one member under one vector of gains. A kernel takes a fixed number of lanes
and is compiled once: one for the terms of the loss, one of fewer lanes for their derivatives, one for metrics. Whatever
the number of starts or members, nothing is recompiled. That number does not depend on the cores, for a last digit may
depend on it. Other steps, as those of the judge, are another engine.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.ensemble import map_members
from ambjax.extend import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import Named, standard_for
from ambjax.simulation.rollout import rollout
from ambjax.world.scenario import Scenario
from tuning.objective.loss import TERMS, Loss, outcomes
from tuning.objective.members import Members, Objective
from tuning.space import Space

# Lanes of one kernel call. Loops over half as many are unrolled into scalar code by XLA's compiler: half again as long.
LANES = 64
# With derivatives, where the loops are longer, halves cost 14 % more each, and most iterations ask for 16 to 64 lanes:
# they keep two cores busy, or are one call. 16 cost 0.63 of 32: a second kernel for few lanes takes longer to compile
# than it saves in a search.
GRADIENT_LANES = 32


class Lane(NamedTuple):
    """What one lane is made of: coordinates [m], member, the world that all share, weights of the terms [6], fold.

    The world: cascade, scenario, clock and loss. The weights and the fold are there where they are asked for.
    """

    x: Any
    who: Members
    world: tuple[Cascade, Scenario, Clock, Loss]
    weights: Any = None
    fold: Any = None


@dataclasses.dataclass(frozen=True)
class LaneFold:
    """The fold's result for a lane."""

    space: Space

    def __call__(self, lane: Lane) -> Any:
        return Objective(self.space, *lane.world).run(lane.x, lane.who, lane.fold)


def measured(world: tuple[Cascade, Scenario, Clock, Any]) -> Any:
    """The result of a fold over the rollout of one member."""
    cascade, scenario, clock, fold = world
    return rollout(cascade, scenario, clock, fold=fold, every=0).measured


@dataclasses.dataclass(frozen=True)
class LaneGradient:
    """The outcomes of a lane [1 + L], its loss and what limits hold, their derivatives [1 + L, m] and the terms, in
    forward or reverse mode."""

    space: Space
    reverse: bool

    def __call__(self, lane: Lane) -> Any:
        if self.reverse:
            values, pull, terms = jax.vjp(lambda x: self._outcomes(x, lane), lane.x, has_aux=True)
            (slopes,) = jax.vmap(pull)(jnp.eye(len(values), dtype=values.dtype))
            return values, slopes, terms

        one = jax.custom_batching.custom_vmap(lambda lane: self._along(self._outcomes, lane))

        # Directions outside, lanes inside: what is contiguous in memory is as long as a vector.
        @one.def_vmap
        def every(size: int, batched: Any, lane: Lane) -> Any:
            axes = jax.tree.map(lambda moves: 0 if moves else None, batched[0])
            results = self._along(jax.vmap(self._outcomes, (0, axes)), lane)
            return results, jax.tree.map(lambda _: True, results)

        return one(lane)

    def _outcomes(self, x: Array, lane: Lane) -> tuple[Array, dict[str, Array]]:
        terms = Objective(self.space, *lane.world).run(x, lane.who, lane.world[-1])
        return jnp.stack(outcomes(lane.weights, terms, lane.who.stressed)), terms

    def _along(self, outcomes: Callable[..., Any], lane: Lane) -> Any:
        """Outcomes, derivatives along each coordinate and terms, of one lane or of many."""

        def along(direction: Array) -> Any:
            every = jnp.broadcast_to(direction, lane.x.shape)
            return jax.jvp(lambda x: outcomes(x, lane), (lane.x,), (every,), has_aux=True)

        return jax.vmap(along, out_axes=(None, -1, None))(jnp.eye(len(self.space)))


class Engine:
    """The lanes of an objective, compiled, on `threads` cores (None: all); a call blocks until its answer is there."""

    def __init__(
        self,
        objective: Objective,
        *,
        settle: float,
        mode: str = "forward",
        threads: int | None = None,
        lanes: int = LANES,
    ):
        self.objective, self.mode, self.settle, self.threads, self.lanes = objective, mode, settle, threads, lanes
        self.rollouts = 0
        self._world: Any = canonical((objective.cascade, objective.scenario, objective.clock, objective.loss))
        self._standard = canonical(Named({"loss": objective.loss, "metrics": standard_for(settle, objective.scenario)}))

    def terms(self, x: np.ndarray, who: Members) -> dict[str, np.ndarray]:
        """Terms of the loss by name, [S, N], of gain vectors x [S, m] and members [N]."""
        self.rollouts += len(x) * len(who.member)
        return self._lanes(LaneFold(self.objective.space), x, who, self.lanes, fold=self._world[-1])

    def metrics(self, x: np.ndarray, who: Members) -> dict[str, Any]:
        """{"loss": terms, "metrics": metrics.json names}, all [S, N].

        With LANES lanes, in the steps of `ambjax ensemble` and of members as they are drawn, these are the bits of its
        members.npz: the gains are constants of the program, as there, and not computed in it from coordinates.
        """
        self.rollouts += len(x) * len(who.member)
        found, block = [], None if self.lanes == LANES else self.lanes
        for one in x:
            world = canonical((*self.objective.fixed(one, who), self.objective.clock, self._standard))
            found.append(map_members(measured, world, threads=self.threads, call=self.lanes, block=block))
        return jax.tree.map(lambda *parts: np.stack(parts), *found)

    def gradient(self, x: np.ndarray, who: Members, weights: Any) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
        """Outcomes [S, N, 1 + L], the weighed loss and what limits hold, their derivatives [S, N, 1 + L, m] and the
        terms [S, N].

        `weights`: of the terms, in the order of TERMS, for all starts or for each: [6] or [S, 6].
        """
        self.rollouts += len(x) * len(who.member) * (len(self.objective.space) + 1)
        each = np.broadcast_to(np.asarray(weights, float), (len(x), len(TERMS)))
        slope = LaneGradient(self.objective.space, self.mode == "reverse")
        return self._lanes(slope, x, who, min(self.lanes, GRADIENT_LANES), weights=each)

    def _lanes(
        self,
        function: LaneFold | LaneGradient,
        x: np.ndarray,
        who: Members,
        width: int,
        weights: Any = None,
        fold: Any = None,
    ) -> Any:
        """The function of every start x [S, m], with weights [S, 6] of its own, and member [N]: leaves [S, N, ...]."""
        start, member = np.divmod(np.arange(len(x) * len(who.member)), len(who.member))
        at = np.asarray(x, jnp.result_type(float))[start]
        those = jax.tree.map(lambda a: a[member], who)
        lane = Lane(at, those, self._world, None if weights is None else weights[start], fold)
        results = map_members(
            function, lane, threads=self.threads, call=width, block=width, plain=self.mode == "reverse"
        )
        return jax.tree.map(lambda a: a.reshape(len(x), len(who.member), *a.shape[1:]), results)
