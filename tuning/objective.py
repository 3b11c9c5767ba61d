"""The objective: gains to one number, through an ensemble with common random numbers.

The work is cut into lanes: one rollout of one member under one vector of gains. A fixed number of lanes
is compiled once into one kernel and serves the screen, every iteration and the held-out ensemble alike, on
as many threads as there are cores; whatever the number of starts or members, nothing is recompiled.
"""

import dataclasses
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.ensemble import Spread, apply, draw
from ambjax.extend import canonical, one_kernel
from ambjax.metrics import Named, Standard
from ambjax.rollout import rollout
from ambjax.scenario import Clock, Scenario
from tuning.loss import TERMS, Loss
from tuning.space import Space

# Lanes of one kernel call. Values: one register of 8 after the other in L1; gradients carry m + 1 numbers per lane.
LANES = 64
GRADIENT_LANES = 32


class Members(NamedTuple):
    """Members of an ensemble: their numbers [n], their seed, and what is spread over them, by path [n]."""

    member: np.ndarray
    seed: int
    values: dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Objective:
    """What is tuned, in which world, and what counts: the part of a study that is compiled."""

    space: Space
    cascade: Cascade
    scenario: Scenario
    clock: Clock
    loss: Loss
    spread: Spread = Spread()

    def members(self, seed: int, count: int) -> Members:
        """The first `count` members of the ensemble with this seed."""
        numbers = np.arange(count)
        values = draw(self.spread, self.cascade, self.scenario, seed, numbers, count) if self.spread.entries else {}
        return Members(numbers, seed, values)

    def world(self, who: Members) -> tuple[Cascade, Scenario]:
        """The cascade (its gains to be replaced) and scenario of one member, whose fields are scalars."""
        scenario = dataclasses.replace(self.scenario, member=who.member, seed=who.seed)
        return apply(self.cascade, scenario, who.values) if who.values else (self.cascade, scenario)

    def run(self, x: Array, who: Members, fold: Any) -> Any:
        """The fold's result for one lane."""
        cascade, scenario = self.world(who)
        return rollout(self.space.decode(x, cascade), scenario, self.clock, fold=fold, every=0).measured


class Engine:
    """Compiled lanes of an objective. Threads share them; a call blocks until its answer is there."""

    def __init__(self, objective: Objective, *, settle: float, mode: str = "forward", threads: int | None = None):
        self.objective, self.mode, self.settle = objective, mode, settle
        self.threads = threads or os.cpu_count() or 1
        self.rollouts = 0
        traced = canonical((objective.cascade, objective.scenario, objective.clock, objective.loss))
        self._world = traced
        standard = canonical(Named({"loss": objective.loss, "metrics": Standard(settle, objective.scenario.touchdown)}))

        def rebuilt(world: Any) -> Objective:
            cascade, scenario, clock, loss = world
            return dataclasses.replace(objective, cascade=cascade, scenario=scenario, clock=clock, loss=loss)

        def terms(x: Array, who: Members, world: Any) -> dict[str, Array]:
            problem = rebuilt(world)
            return problem.run(x, who, problem.loss)

        def measured(x: Array, who: Members, world: Any, fold: Any) -> dict[str, Array]:
            return rebuilt(world).run(x, who, fold)

        def total(x: Array, who: Members, world: Any, weights: Array) -> tuple[Array, dict[str, Array]]:
            found = terms(x, who, world)
            return sum(weights[k] * found[name] for k, name in enumerate(TERMS)), found  # pyright: ignore

        def forward(x: Array, who: Members, world: Any, weights: Array) -> Any:
            def along(direction: Array) -> Any:
                return jax.jvp(lambda x: total(x, who, world, weights), (x,), (direction,), has_aux=True)

            value, slope, found = jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(len(objective.space)))
            return value, slope, found

        def reverse(x: Array, who: Members, world: Any, weights: Array) -> Any:
            (value, found), slope = jax.value_and_grad(total, has_aux=True)(x, who, world, weights)
            return value, slope, found

        axes: Any = (0, Members(0, 0, 0), None)  # pyright: ignore[reportArgumentType]
        self._terms = one_kernel(jax.vmap(terms, axes))
        self._standard = lambda x, who, world: measured_lanes(x, who, world, standard)
        measured_lanes = one_kernel(jax.vmap(measured, (*axes, None)))
        if mode == "forward":
            self._gradient = one_kernel(jax.vmap(forward, (*axes, None)))
        else:  # the fast path does not compile reverse mode
            self._gradient = jax.jit(jax.vmap(reverse, (*axes, None)))

    def terms(self, x: np.ndarray, who: Members) -> dict[str, np.ndarray]:
        """Terms of the loss by name, [S, N], of gain vectors x [S, m] and members [N]."""
        self.rollouts += len(x) * len(who.member)
        return self._lanes(lambda x, who: self._terms(x, who, self._world), LANES, x, who)

    def metrics(self, x: np.ndarray, who: Members) -> dict[str, Any]:
        """{"loss": terms, "metrics": metrics.json names}, all [S, N]."""
        self.rollouts += len(x) * len(who.member)
        return self._lanes(lambda x, who: self._standard(x, who, self._world), LANES, x, who)

    def gradient(self, x: np.ndarray, who: Members, weights: Any) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
        """Weighted losses [S, N], their derivatives [S, N, m] and the terms [S, N]."""
        self.rollouts += len(x) * len(who.member) * (len(self.objective.space) + 1)
        weights = jnp.asarray(weights)
        return self._lanes(lambda x, who: self._gradient(x, who, self._world, weights), GRADIENT_LANES, x, who)

    def _lanes(self, call: Callable[..., Any], width: int, x: np.ndarray, who: Members) -> Any:
        starts, count = len(x), len(who.member)
        lane = np.arange(starts * count)
        padded = np.concatenate([lane, np.zeros(-len(lane) % width, int)]).reshape(-1, width)

        def one(lanes: np.ndarray) -> Any:
            start, member = np.divmod(lanes, count)
            chosen = Members(
                jnp.asarray(who.member[member]),
                jnp.full(width, who.seed),  # pyright: ignore[reportArgumentType]
                {path: jnp.asarray(v[member]) for path, v in who.values.items()},  # pyright: ignore
            )
            return jax.tree.map(np.asarray, call(jnp.asarray(x[start], jnp.result_type(float)), chosen))

        parts = [one(padded[0])]  # alone: the first call compiles
        if self.threads > 1 and len(padded) > 2:
            with ThreadPoolExecutor(self.threads) as pool:
                parts += pool.map(one, padded[1:])
        else:
            parts += map(one, padded[1:])
        joined = jax.tree.map(lambda *p: np.concatenate(p)[: len(lane)], *parts)
        return jax.tree.map(lambda a: a.reshape(starts, count, *a.shape[1:]), joined)
