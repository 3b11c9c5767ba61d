"""The objective: gains to one number, through an ensemble with common random numbers.

The work is cut into lanes: one rollout of one member under one vector of gains. A fixed number of lanes
is compiled once into one kernel and serves the screen, every iteration and the held-out ensemble alike, on
as many threads as there are cores; whatever the number of starts or members, nothing is recompiled. That number does
not depend on the cores, for a last digit may depend on it.
"""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.ensemble import Spread, apply, draw
from ambjax.ensemble.engine import cores
from ambjax.extend import canonical, one_kernel
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import Named, standard_for
from ambjax.simulation.rollout import rollout
from ambjax.world.scenario import Scenario
from tuning.objective.loss import TERMS, Loss
from tuning.space import Space

# Lanes of one kernel call. Loops over half as many are unrolled into scalar code by XLA's compiler: half again as long.
LANES = 64
# With derivatives, where the loops are longer, halves cost 14 % more each, and most iterations ask for 16 to 64 lanes:
# they keep two cores busy, or are one call without padding.
GRADIENT_LANES = 32
# Members of a kind that say something about all of it.
FEWEST = 4
# Terms that say whether the rotor is held.
HELD = ("clearance", "survival")
# Terms that are a price, not an aim.
COSTS = ("effort", "chatter")


class Members(NamedTuple):
    """Members of an ensemble: their numbers [n], seed, and what is spread over them by path [n].

    `stressed` [n], the last ones: members of whom nothing is asked but to be held, with sensors `loud` [n] times as
    noisy, under gains that are off by `shift` [n, m], in coordinates.
    """

    member: Any
    seed: Any
    values: dict[str, Any]
    loud: Any
    shift: Any
    stressed: Any

    @property
    def ordinary(self) -> int:
        """How many are not stressed."""
        return int(np.sum(~self.stressed))

    def joined(self, others: "Members") -> "Members":
        """These and others, who are asked only to be held and come first among such."""
        more, n = others._replace(stressed=np.ones(len(others.stressed), bool)), self.ordinary
        return jax.tree.map(lambda a, b: np.concatenate([a[:n], b, a[n:]]), self, more)

    def part(self, share: int, held: int | None = None) -> "Members":
        """The first of either kind, FEWEST at least: ordinary ones, one in `share`, then those asked to be held.

        Of these one in `held`; left out: one in `share` too.
        """
        kinds = (self.ordinary, share), (len(self.stressed) - self.ordinary, held or share)
        few, some = (max(count // each, min(FEWEST, count)) for count, each in kinds)
        index = np.concatenate([np.arange(few), np.arange(self.ordinary, self.ordinary + some)])
        return jax.tree.map(lambda a: a[index], self)


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
        return self.chosen(seed, np.arange(count), count)

    def training(self, seed: int, count: int, extra: int, noise: float, gains: float) -> Members:
        """`count` members, and `extra` more, stressed: noise times `noise`, every gain off by a factor of `gains`.

        The first of these has all gains above, the second all below, the others a mixture drawn from the seed.
        """
        who = self.members(seed, count + extra)
        stressed = who.member >= count
        sign = np.random.default_rng(seed).choice([-1.0, 1.0], (count + extra, len(self.space)))
        sign[count : count + 2] = np.array([[1.0], [-1.0]])[:extra]
        shift = np.log(gains) * np.where(stressed[:, None], sign, 0.0)
        return who._replace(loud=np.where(stressed, noise, 1.0), shift=shift, stressed=stressed)

    def chosen(self, seed: int, numbers: np.ndarray, total: int) -> Members:
        """Members with these numbers of an ensemble of `total`."""
        values = draw(self.spread, self.cascade, self.scenario, seed, numbers, total) if self.spread.entries else {}
        n = len(numbers)
        still = np.zeros((n, len(self.space)))
        return Members(numbers, np.full(n, seed), values, np.ones(n), still, np.zeros(n, bool))

    def world(self, who: Members) -> tuple[Cascade, Scenario]:
        """The cascade (its gains to be replaced) and scenario of one member, whose fields are scalars."""
        scenario = dataclasses.replace(self.scenario, member=who.member, seed=who.seed)
        cascade, scenario = apply(self.cascade, scenario, who.values) if who.values else (self.cascade, scenario)
        sensor = jax.tree.map(lambda std: std * who.loud, scenario.sensor)
        return cascade, dataclasses.replace(scenario, sensor=sensor)

    def run(self, x: Array, who: Members, fold: Any) -> Any:
        """The fold's result for one lane."""
        cascade, scenario = self.world(who)
        return rollout(self.space.decode(x + who.shift, cascade), scenario, self.clock, fold=fold, every=0).measured


def weigh(weights: Any, terms: dict[str, Any], stressed: Any) -> Any:
    """The loss: errors and losses weighed and added, times 1 + weighed costs; of a stressed member, HELD alone.

    Costs count relative to the error, since its size is not known before: with a weight of 0.1, voltage at
    its limit throughout is worth a tenth of the error.
    """
    ordinary = 1.0 - 1.0 * stressed
    each = dict(zip(TERMS, (weights[k] * terms[name] for k, name in enumerate(TERMS)), strict=True))
    costs = sum(each.pop(name) for name in COSTS)
    held = sum(each.pop(name) for name in HELD)
    return held + ordinary * sum(each.values()) * (1 + costs)


class Engine:
    """Compiled lanes of an objective. Threads share them; a call blocks until its answer is there."""

    def __init__(
        self,
        objective: Objective,
        *,
        settle: float,
        mode: str = "forward",
        threads: int | None = None,
        lanes: int = LANES,
    ):
        self.objective, self.mode, self.settle = objective, mode, settle
        self.lanes = {"terms": lanes, "metrics": lanes, "gradient": min(lanes, GRADIENT_LANES)}
        self.threads = threads or cores()
        self.rollouts = 0
        self._compiled: set[str] = set()
        traced = canonical((objective.cascade, objective.scenario, objective.clock, objective.loss))
        self._world = traced
        standard = canonical(Named({"loss": objective.loss, "metrics": standard_for(settle, objective.scenario)}))

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
            return weigh(weights, found, who.stressed), found

        axes: Any = (0, Members(0, 0, 0, 0, 0, 0), None)  # pyright: ignore[reportArgumentType]

        def forward(x: Array, who: Members, world: Any, weights: Array) -> Any:
            lanes = jax.vmap(total, (*axes, 0))

            # Directions outside, lanes inside: what is contiguous in memory is as long as a vector.
            def along(direction: Array) -> Any:
                every = jnp.broadcast_to(direction, x.shape)
                return jax.jvp(lambda x: lanes(x, who, world, weights), (x,), (every,), has_aux=True)

            return jax.vmap(along, out_axes=(None, -1, None))(jnp.eye(len(objective.space)))

        def reverse(x: Array, who: Members, world: Any, weights: Array) -> Any:
            (value, found), slope = jax.value_and_grad(total, has_aux=True)(x, who, world, weights)
            return value, slope, found

        self._terms = one_kernel(jax.vmap(terms, axes))
        measured_lanes = one_kernel(jax.vmap(measured, (*axes, None)))
        self._standard = lambda x, who, world: measured_lanes(x, who, world, standard)
        if mode == "forward":
            self._gradient = one_kernel(forward)
        else:  # the fast path does not compile reverse mode
            self._gradient = jax.jit(jax.vmap(reverse, (*axes, 0)))

    def terms(self, x: np.ndarray, who: Members) -> dict[str, np.ndarray]:
        """Terms of the loss by name, [S, N], of gain vectors x [S, m] and members [N]."""
        self.rollouts += len(x) * len(who.member)
        return self._lanes("terms", lambda x, who: self._terms(x, who, self._world), x, who)

    def metrics(self, x: np.ndarray, who: Members) -> dict[str, Any]:
        """{"loss": terms, "metrics": metrics.json names}, all [S, N]."""
        self.rollouts += len(x) * len(who.member)
        return self._lanes("metrics", lambda x, who: self._standard(x, who, self._world), x, who)

    def gradient(self, x: np.ndarray, who: Members, weights: Any) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
        """Weighted losses [S, N], their derivatives [S, N, m] and the terms [S, N].

        `weights`: of the terms, in the order of TERMS, for all starts or for each: [6] or [S, 6].
        """
        self.rollouts += len(x) * len(who.member) * (len(self.objective.space) + 1)
        # the weights travel with the coordinates, each lane with its own
        each = np.broadcast_to(np.asarray(weights, float), (len(x), len(TERMS)))
        both, m = np.concatenate([x, each], axis=1), x.shape[1]
        return self._lanes(
            "gradient", lambda both, who: self._gradient(both[:, :m], who, self._world, both[:, m:]), both, who
        )

    def _lanes(self, kind: str, call: Callable[..., Any], x: np.ndarray, who: Members) -> Any:
        starts, count = len(x), len(who.member)
        lane = np.arange(starts * count)
        width = self.lanes[kind]
        padded = np.concatenate([lane, np.zeros(-len(lane) % width, int)]).reshape(-1, width)

        def one(lanes: np.ndarray) -> Any:
            start, member = np.divmod(lanes, count)
            at = jnp.asarray(x[start], jnp.result_type(float))
            return jax.tree.map(np.asarray, call(at, jax.tree.map(lambda a: a[member], who)))

        alone = 0 if kind in self._compiled else 1  # the first call of its kind compiles
        parts = [one(lanes) for lanes in padded[:alone]]
        self._compiled.add(kind)
        if self.threads > 1 and len(padded) > alone + 1:
            with ThreadPoolExecutor(self.threads) as pool:
                parts += pool.map(one, padded[alone:])
        else:
            parts += map(one, padded[alone:])
        joined = jax.tree.map(lambda *p: np.concatenate(p)[: len(lane)], *parts)
        return jax.tree.map(lambda a: a.reshape(starts, count, *a.shape[1:]), joined)
