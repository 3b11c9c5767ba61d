"""The closed loop as a function of time and state, for solvers of other packages."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.cases.given import of_case
from ambjax.cases.reader import Case
from ambjax.numerics.records import canonical
from ambjax.simulation.loop import ClosedLoop, LoopState


class VectorField(NamedTuple):
    """The equations y' = f(t, y) of a closed loop in continuous time. `y_0`: state at t = 0 [N].

    `f`: returns the rate [N] of the state at time t (s) in the state y [N]. It ignores a third argument, which diffrax
    passes. It is compiled, and can be differentiated. `named`: returns the state as a tree: `plant` with z (m), z_dot
    (m/s) and the currents (A), and `control`.
    """

    f: Callable[..., Array]
    y_0: Array
    named: Callable[[Array], LoopState]


@of_case(traced=True)
def vector_field(case: Case) -> VectorField:
    """Return the equations of the closed loop of a case, for scipy.integrate.solve_ivp or a diffrax.ODETerm.

    Returns a `VectorField`. Sensor noise is left out, because it is held over samples. A solver does not stop where the
    rotor touches down. Raises ValueError for a controller on a processor, because its loop is not a differential
    equation.

        field = ambjax.vector_field(case)
        scipy.integrate.solve_ivp(field.f, (0.0, 0.1), field.y_0, "Radau")
    """
    if case.cascade.sampled:
        raise ValueError(
            "vector_field: this controller runs on a processor, so its loop is not a differential equation. Remove "
            "[processor] from the case, or use ambjax.simulate."
        )
    scenario = case.scenario.in_continuous_time()
    cascade, scenario = canonical((case.cascade, scenario))
    loop = ClosedLoop(cascade, scenario.louder(0.0)).realised()
    errors = loop.sensor_errors(0)
    y_0, restored = ravel_pytree(loop.start())

    def named(y: Any) -> LoopState:
        if jnp.shape(y) != y_0.shape:
            raise ValueError(f"y has the shape {list(jnp.shape(y))}: it must be {list(y_0.shape)}, as that of y_0.")
        return restored(jnp.asarray(y))

    @jax.jit
    def f(t: Any, y: Any, args: Any = None) -> Array:
        return ravel_pytree(loop.rates(loop.inputs(t), named(y), errors))[0]

    return VectorField(f, y_0, named)
