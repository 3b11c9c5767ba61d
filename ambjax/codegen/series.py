"""The inputs of an exported block at every sample of a case: disturbances, random numbers of sensors, reference."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.codegen.interface import LoopInputs
from ambjax.control.cascade import Cascade
from ambjax.numerics.gaussian import normals
from ambjax.numerics.records import Scalar, canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import sampled_of
from ambjax.world.scenario import Scenario


def just_after(t: Scalar) -> Scalar:
    """Return the instant (s) at which the simulator evaluates signals for the sample at t: a jump at t has happened."""
    return t * (1 + 4 * float(jnp.finfo(jnp.result_type(float)).eps))


def series(cascade: Cascade, scenario: Scenario, clock: Clock, samples: int) -> dict[str, np.ndarray]:
    """Return the inputs of the loop at samples 0 to `samples` - 1, by name.

    The disturbances for sample n are those of the sample before, because these act until sample n.
    """
    given = sampled_of(cascade, scenario, clock)
    found = _series(canonical(given), jnp.arange(samples))
    return {name: np.asarray(x) for name, x in found._asdict().items()}


@jax.jit
def _series(system: Sampled, samples: Array) -> LoopInputs:
    loop = system.loop.realised()

    def one(n: Array) -> LoopInputs:
        t = just_after(n * system.period)
        before = just_after(jnp.maximum(n - 1, 0) * system.period)
        outside, w = loop.inputs(before), normals(loop.words(), n)
        return LoopInputs._make([outside.q_z, outside.q_i, *(w[k] for k in range(3)), *system.reference(t)])

    return jax.vmap(one)(samples)
