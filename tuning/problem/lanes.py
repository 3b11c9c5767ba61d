"""The engine: evaluates an objective and its derivatives for many gains and members, with common random numbers.

A lane is one rollout of one member under one vector of gains. A kernel processes a fixed number of lanes and is
compiled once: for the terms of the loss, for their derivatives (with fewer lanes), or for metrics. The number of lanes
can change the last digit of a result, so it does not depend on the number of cores.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.ensemble import map_members
from ambjax.extend import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import Named
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.rollout import rollout
from ambjax.world.scenario import Scenario
from tuning.problem.limits import PREFIX
from tuning.problem.loops import loops
from tuning.problem.loss import TERMS, Loss, outcomes
from tuning.problem.members import Members, Objective
from tuning.problem.space import Space

# Lanes of one kernel call. With 32 lanes XLA unrolls the loops into scalar code, which takes 1.5 times as long.
# A call with derivatives has half as many. Most iterations need 16 to 64 lanes. With calls of 32 lanes, two cores can
# share 64. In sequence, two such calls take 14 % longer than one of 64 lanes. A call of 16 lanes takes 0.63 of the time
# of one of 32; a second kernel for few lanes would take longer to compile than it saves in a search.
LANES = 64


class Lane(NamedTuple):
    """The inputs of one lane.

    `x` [m]: coordinates of the gains. `members`: one member (scalar fields). `world`: the cascade, scenario, clock and
    loss, shared by all lanes. `weights` [6]: weights of the terms of the loss; None unless derivatives are computed.
    `fold`: fold to evaluate; None if derivatives are computed.
    """

    x: Any
    members: Members
    world: tuple[Cascade, Scenario, Clock, Loss]
    weights: Any = None
    fold: Any = None


@dataclasses.dataclass(frozen=True)
class LaneFold:
    """Function of a lane that returns the result of its fold. `space`: the gains that the tuner may change."""

    space: Space

    def __call__(self, lane: Lane) -> Any:
        return Objective(self.space, *lane.world).run(lane.x, lane.members, lane.fold)


def measured(world: tuple[Cascade, Scenario, Clock, Any]) -> Any:
    """Return the result of a fold over the rollout of one member. `world`: cascade, scenario, clock and fold."""
    cascade, scenario, clock, fold = world
    return rollout(cascade, scenario, clock, fold=fold, record_every=0).metrics


@dataclasses.dataclass(frozen=True)
class LaneGradient:
    """Function of a block of n lanes that returns their outcomes, the derivatives of these, and the terms of the loss.

    The outcomes [n, 1 + L] are the weighted loss and the L limited quantities. Their derivatives [n, 1 + L, m] with
    respect to the coordinates are computed in reverse mode if `reverse` is true, otherwise in forward mode.
    """

    space: Space
    reverse: bool

    def __call__(self, lanes: Lane, axes: Lane) -> Any:
        """Evaluate a block of lanes. `axes`: axis of each leaf, 0 or None, as for `jax.vmap`."""
        if self.reverse:

            def pulled(lane: Lane) -> Any:
                values, pull, terms = jax.vjp(lambda x: self._outcomes(x, lane), lane.x, has_aux=True)
                (slopes,) = jax.vmap(pull)(jnp.eye(len(values), dtype=values.dtype))
                return values, slopes, terms

            return jax.vmap(pulled, (axes,))(lanes)
        each = jax.vmap(self._outcomes, (0, axes))

        # The outer map is over directions and the inner one over lanes, so the lanes are contiguous in memory.
        def along(direction: Array) -> Any:
            every = jnp.broadcast_to(direction, lanes.x.shape)
            return jax.jvp(lambda x: each(x, lanes), (lanes.x,), (every,), has_aux=True)

        return jax.vmap(along, out_axes=(None, -1, None))(jnp.eye(len(self.space)))

    def _outcomes(self, x: Array, lane: Lane) -> tuple[Array, dict[str, Array]]:
        objective = Objective(self.space, *lane.world)
        terms = objective.run(x, lane.members, lane.world[-1], in_parts=self.reverse)
        return jnp.stack(outcomes(lane.weights, terms, lane.members.stressed, sorted(lane.world[-1].measures))), terms


class Engine:
    """Compiled evaluation of an objective on `threads` cores (None: all). Each call blocks until its result is ready.

    `settle` (s): start of the settled part of the metrics. `mode`: "forward" or "reverse" differentiation. `lanes`:
    lanes of one kernel call; with derivatives at most half of LANES. `rollouts` counts the rollouts so far; `gradient`
    counts as 1 + m for each start and member.
    """

    def __init__(
        self,
        objective: Objective,
        *,
        settle: float,
        mode: str = "forward",
        threads: int | None = None,
        lanes: int = LANES,
    ) -> None:
        self.objective, self.mode, self.settle, self.threads, self.lanes = objective, mode, settle, threads, lanes
        self.rollouts = 0
        self._world: Any = canonical((objective.cascade, objective.scenario, objective.clock, objective.loss))
        self._standard = canonical(Named({"loss": objective.loss, "metrics": Metrics.of(settle, objective.scenario)}))

    def terms(self, x: np.ndarray, members: Members) -> dict[str, np.ndarray]:
        """Return the terms of the loss by name, each [S, N], at coordinates x [S, m] for members [N].

        If a limit needs linearised loops, their quantities are included. They are 1 for members not in `searched`.
        """
        self.rollouts += len(x) * len(members.member)
        terms = self._lanes(LaneFold(self.objective.space), x, members, self.lanes, fold=self._world[-1])
        if self.objective.loop is not None:
            values = loops(self.objective, x, members.searched)[0]
            terms |= {PREFIX + name: _wide(one, len(members.member)) for name, one in values.items()}
        return terms

    def metrics(self, x: np.ndarray, members: Members) -> dict[str, Any]:
        """Return {"loss": terms, "metrics": the metrics of metrics.json}, each [S, N], at x [S, m] for members [N].

        The gains are numbers shared by all lanes, as in `ambjax ensemble`. With LANES lanes, the same integration
        method and members that are not stressed, the metrics therefore equal those of members.npz bit by bit.
        """
        self.rollouts += len(x) * len(members.member)
        found, block = [], None if self.lanes == LANES else self.lanes
        for one in x:
            world = canonical((*self.objective.fixed(one, members), self.objective.clock, self._standard))
            found.append(map_members(measured, world, threads=self.threads, call=self.lanes, block=block))
        metrics = jax.tree.map(lambda *parts: np.stack(parts), *found)
        if self.objective.loop is not None:
            values = loops(self.objective, x, members)[0]
            metrics["loss"] |= {PREFIX + name: one for name, one in values.items()}
        return metrics

    def gradient(
        self, x: np.ndarray, members: Members, weights: npt.ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Return outcomes [S, N, 1 + L], their derivatives [S, N, 1 + L, m] and the terms [S, N] at x [S, m].

        The outcomes are the weighted loss and the L limited quantities. `weights`: weights of the terms, in the order
        of TERMS, for all starts [6] or for each start [S, 6].
        """
        self.rollouts += len(x) * len(members.member) * (len(self.objective.space) + 1)
        each = np.broadcast_to(np.asarray(weights, float), (len(x), len(TERMS)))
        slope = LaneGradient(self.objective.space, self.mode == "reverse")
        found = self._lanes(slope, x, members, min(self.lanes, LANES // 2), weights=each, vectorised=True)
        return found if self.objective.loop is None else self._with_loops(found, x, members)

    def _with_loops(
        self, found: tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]], x: np.ndarray, members: Members
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Append the quantities of the linearised loops to the results of `gradient`.

        For members not in `members.searched`, the quantities are 1 and their derivatives 0.
        """
        outcomes, slopes, terms = found
        values, moves = loops(self.objective, x, members.searched)
        values = {name: _wide(one, len(members.member)) for name, one in values.items()}
        outcomes = np.concatenate([outcomes, np.stack(list(values.values()), -1)], -1)
        moves = np.stack([_wide(one, len(members.member), 0.0) for one in moves.values()], -2)
        return outcomes, np.concatenate([slopes, moves], -2), terms | {PREFIX + k: one for k, one in values.items()}

    def _lanes(
        self,
        function: LaneFold | LaneGradient,
        x: np.ndarray,
        members: Members,
        width: int,
        weights: Any = None,
        fold: Any = None,
        vectorised: bool = False,
    ) -> Any:
        """Apply the function to each pair of a start x [S, m], with its weights [S, 6], and a member [N].

        Returns leaves [S, N, ...]. `width`: lanes of one kernel call. `vectorised`: as in `map_members`.
        """
        start, member = np.divmod(np.arange(len(x) * len(members.member)), len(members.member))
        at = np.asarray(x, jnp.result_type(float))[start]
        selected = jax.tree.map(lambda a: a[member], members)
        world = (self.objective.notched(at, self._world[0]), *self._world[1:])
        lane = Lane(at, selected, world, None if weights is None else weights[start], fold)
        cut = {"threads": self.threads, "call": width, "block": width}
        results = map_members(function, lane, vectorised=vectorised, **cut)
        return jax.tree.map(lambda a: a.reshape(len(x), len(members.member), *a.shape[1:]), results)


def _wide(values: np.ndarray, count: int, fill: float = 1.0) -> np.ndarray:
    """Return values [S, n, ...] of the first n members, extended to `count` members with the value `fill`."""
    wide = np.full((len(values), count, *values.shape[2:]), fill)
    wide[:, : values.shape[1]] = values
    return wide
