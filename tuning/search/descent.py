"""Descent: where a start is tried next, from the losses and derivatives of the members at its last trial."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from tuning import optimisers
from tuning.objective.goal import Goal
from tuning.space import Space

# A refused step of an optimiser of optax's is tried again at this share of its length.
SHORTER = 0.25
# A trial whose goal, a logarithm, is worse than the best by more than this is behind a cliff.
CLIFF = 1.0


class Starts(NamedTuple):
    """All starts: the point to try and the best so far [S, m], loss there [S], optimiser's state, step taken [S]."""

    trial: Array
    best: Array
    value: Array
    memory: Any
    length: Array
    refused: Array


class Descent:
    """Starts that descend, each on its own, by the optimiser of this name; compiled once."""

    def __init__(self, space: Space, goal: Goal, name: str, rate: float):
        self.space, self.goal = space, goal
        self.method = None if name == optimisers.BFGS else optimisers.optimiser(name, rate)

    @functools.partial(jax.jit, static_argnums=0)
    def begin(self, x: Array, inverse: Array | None = None) -> Starts:
        """At coordinates x [S, m]; the BFGS with inverse Hessians [S, m, m], if they are known."""
        never = jnp.full(x.shape[0], jnp.inf, x.dtype)
        if self.method is not None:
            memory = jax.vmap(self.method.init)(x)
        else:
            memory = jax.vmap(optimisers.begin, (0, None if inverse is None else 0))(x, inverse)
        return Starts(x, x, never, memory, never, jnp.zeros(x.shape[0], int))

    def anew(self, x: Array, starts: Starts) -> Starts:
        """At coordinates x [S, m], for another goal that has the curvature of the one that these starts descended."""
        return self.begin(x, starts.memory.inverse) if self.method is None else self.begin(x)

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def step(self, ordinary: int, starts: Starts, losses: Array, slopes: Array, on: Array) -> Starts:
        """What losses [S, N] and slopes [S, N, m] at the trials make of the starts that are `on` [S].

        The first `ordinary` of the members are not stressed.
        """
        return jax.vmap(functools.partial(self._one, ordinary))(starts, losses, slopes, on)

    def _one(self, ordinary: int, start: Starts, losses: Array, slopes: Array, on: Array) -> Starts:
        goal = self.goal
        value, weights = jax.value_and_grad(goal.of)(losses, ordinary, 0.0)
        extra, slope = jax.value_and_grad(lambda x: goal.weight * goal.penalty(self.space, x))(start.trial)
        value, gradient = value + extra, weights @ slopes + slope
        finite = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        better = finite & (value < start.value)
        accept = better if self.method is None else finite
        best = jnp.where(better, start.trial, start.best)
        smooth = finite & (value < start.value + CLIFF)
        trial, memory = self._next(start, jnp.where(finite, gradient, 0.0), accept, smooth)
        length = jnp.linalg.norm(trial - best)
        refused = jnp.where(accept, 0, start.refused + 1)
        fresh = Starts(trial, best, jnp.where(better, value, start.value), memory, length, refused)
        return jax.tree.map(lambda p, q: jnp.where(on, p, q), fresh, start)

    def _next(self, start: Starts, gradient: Array, accept: Array, smooth: Array) -> tuple[Array, Any]:
        """The next trial and the optimiser's state; that of optax's does not see a refused trial."""
        if self.method is None:
            return optimisers.bfgs(start.memory, start.trial, gradient, accept, smooth)
        step: Any
        step, memory = self.method.update(gradient, start.memory, start.trial)
        trial = jnp.where(accept, start.trial + step, start.best + SHORTER * (start.trial - start.best))
        return trial, jax.tree.map(lambda p, q: jnp.where(accept, p, q), memory, start.memory)
