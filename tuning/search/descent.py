"""Descent: where a start is tried next, from the losses and derivatives of the members at its last trial."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from tuning.objective.goal import Goal
from tuning.optimisers import Curvature, Retreat, optimiser


class Starts(NamedTuple):
    """All starts: the point to try [S, m], the optimiser's state, the distance from the best point to the trial [S],
    and the norm of the goal's gradient at the best point [S]."""

    trial: Array
    state: Curvature | Retreat
    length: Array
    rise: Array

    @property
    def best(self) -> Array:
        """The best points so far [S, m]."""
        return self.state.best

    @property
    def value(self) -> Array:
        """The goal there [S]; +inf where nothing was tried."""
        return self.state.value


class Descent:
    """Starts that descend, each on its own, by the optimiser of this name; compiled once."""

    def __init__(self, goal: Goal, name: str, rate: float):
        self.goal, self.method = goal, optimiser(name, rate)

    @functools.partial(jax.jit, static_argnums=0)
    def begin(self, x: Array) -> Starts:
        """At coordinates x [S, m]."""
        state: Any = jax.vmap(self.method.init)(x)
        infinite = jnp.full(len(x), jnp.inf, x.dtype)
        return Starts(x, state, infinite, infinite)

    @functools.partial(jax.jit, static_argnums=0)
    def anew(self, x: Array, starts: Starts) -> Starts:
        """At coordinates x [S, m], for another goal that has the curvature of the one that these starts descended."""
        begun = self.begin(x)
        return begun._replace(state=jax.vmap(lambda old, fresh: old.anew(fresh))(starts.state, begun.state))

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def step(self, ordinary: int, starts: Starts, outcomes: Array, slopes: Array, on: Array) -> Starts:
        """What outcomes [S, N, 1 + L] and slopes [S, N, 1 + L, m] at the trials make of the starts that are `on` [S].

        The first `ordinary` of the members are not stressed.
        """
        return jax.vmap(functools.partial(self._one, ordinary))(starts, outcomes, slopes, on)

    def _one(self, ordinary: int, start: Starts, outcomes: Array, slopes: Array, on: Array) -> Starts:
        value, (weights, slope) = jax.value_and_grad(self.goal, (0, 1))(outcomes, start.trial, ordinary)
        gradient: Any = jnp.tensordot(weights, slopes, 2) + slope
        state: Any
        step, state = self.method.update(gradient, start.state, start.trial, value=value)
        trial: Any = optax.apply_updates(start.trial, step)
        rise = jnp.where(state.value < start.value, jnp.linalg.norm(gradient), start.rise)
        fresh = Starts(trial, state, jnp.linalg.norm(trial - state.best), rise)
        return jax.tree.map(lambda p, q: jnp.where(on, p, q), fresh, start)
