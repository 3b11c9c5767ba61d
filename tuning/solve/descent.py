"""Descent: the next trial of each start, computed from the members' losses and derivatives at the last trial.

A start is a point that the search refines, with the state of its optimiser.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from ambjax.extend import record, static
from tuning.optimisers import BFGSState, FirstOrderState, optimiser
from tuning.problem.goal import Goal


class Starts(NamedTuple):
    """State of all starts.

    `trial` [S, m]: next points. `state`: of the optimiser. `length` [S]: distance from the best point to the trial.
    `gradient_norm` [S]: norm of the goal's gradient at the best point.
    """

    trial: Array
    state: BFGSState | FirstOrderState
    length: Array
    gradient_norm: Array

    @property
    def best(self) -> Array:
        """The best points so far [S, m]."""
        return self.state.best

    @property
    def value(self) -> Array:
        """The goal at the best points [S]; +inf before the first trial."""
        return self.state.value


@record
class Descent:
    """Independent descents of several starts by the optimiser `name` with the learning rate `rate`.

    The numbers of the limits are leaves, so its functions are compiled once for all goals of the same structure.
    """

    goal: Goal
    name: str = static()
    rate: float = static()

    @property
    def method(self) -> optax.GradientTransformationExtraArgs:
        """The optimiser."""
        return optimiser(self.name, self.rate)

    @jax.jit
    def begin(self, x: Array) -> Starts:
        """Return the initial state at coordinates x [S, m]."""
        state: Any = jax.vmap(self.method.init)(x)
        infinite = jnp.full(len(x), jnp.inf, x.dtype)
        return Starts(x, state, infinite, infinite)

    @functools.partial(jax.jit, static_argnums=1)
    def step(self, ordinary: int, starts: Starts, outcomes: Array, slopes: Array, on: Array) -> Starts:
        """Return the starts after one step. `on` [S]: whether each start makes the step.

        `outcomes` [S, N, 1 + L]: the weighted loss and the limited quantities of each member at the trials. `slopes`
        [S, N, 1 + L, m]: their derivatives. The first `ordinary` members are not stressed.
        """
        return jax.vmap(functools.partial(self._one, ordinary))(starts, outcomes, slopes, on)

    def _one(self, ordinary: int, start: Starts, outcomes: Array, slopes: Array, on: Array) -> Starts:
        value, (weights, slope) = jax.value_and_grad(self.goal, (0, 1))(outcomes, start.trial, ordinary)
        gradient: Any = jnp.tensordot(weights, slopes, 2) + slope
        state: Any
        step, state = self.method.update(gradient, start.state, start.trial, value=value)
        trial: Any = optax.apply_updates(start.trial, step)
        gradient_norm = jnp.where(state.value < start.value, jnp.linalg.norm(gradient), start.gradient_norm)
        fresh = Starts(trial, state, jnp.linalg.norm(trial - state.best), gradient_norm)
        return jax.tree.map(lambda p, q: jnp.where(on, p, q), fresh, start)
