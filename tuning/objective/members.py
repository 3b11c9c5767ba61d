"""The members that gains are tuned on, and the objective: gains and a member to what a fold of its rollout says."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.ensemble import Spread, apply, draw
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import rollout
from ambjax.world.scenario import Scenario
from tuning.objective.loss import Loss
from tuning.space import Space

# Members of a kind that say something about all of it.
FEWEST = 4


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

    @property
    def unstressed(self) -> "Members":
        """Those who are not stressed."""
        return jax.tree.map(lambda a: a[: self.ordinary], self)

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
    """What is tuned, in which world, and what counts: the part of a problem that is compiled."""

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
        return cascade, _louder(scenario, who.loud)

    def fixed(self, x: np.ndarray, who: Members) -> tuple[Cascade, Scenario]:
        """The cascade with the gains at x [m] and the scenario of the members [n]; leaves that vary are arrays [n]."""
        seed = who.seed if np.ptp(who.seed) else int(who.seed[0])
        scenario = dataclasses.replace(self.scenario, member=np.asarray(who.member), seed=seed)
        cascade, scenario = apply(self.cascade, scenario, who.values)
        at = (x + who.shift).T if np.any(who.shift) else x  # of each gain one coordinate, or [n]
        cascade = self.space.decode(jnp.asarray(at), cascade)
        return cascade, _louder(scenario, who.loud) if np.any(who.loud != 1) else scenario

    def run(self, x: Array, who: Members, fold: Any) -> Any:
        """The fold's result for one lane."""
        cascade, scenario = self.world(who)
        return rollout(self.space.decode(x + who.shift, cascade), scenario, self.clock, fold=fold, every=0).measured


def _louder(scenario: Scenario, loud: Any) -> Scenario:
    """The scenario with `loud` times the sensors' noise."""
    sensor = scenario.sensor
    return scenario if sensor is None else dataclasses.replace(scenario, sensor=sensor.louder(loud))
