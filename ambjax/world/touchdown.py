"""The touchdown bearing: a stop at the clearance, which the rotor may touch."""

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, bounded, leaf, record
from ambjax.world.sensor import Measurement

# Penetration over which the damping rises to its full value, as a share of the clearance.
DAMPING_DEPTH = 1e-3


@record
class Stop:
    """An elastic, damped stop at |z| = gap. It pushes the rotor back and never pulls it.

    With the penetration d = |z| - gap > 0, the stiffness k and the damping c, its force is max(0, k d + c s d'). The
    share s rises from 0 to 1 as 3 x^2 - 2 x^3 with x = d / (DAMPING_DEPTH gap), so the force is continuous at the first
    contact. This is a Kelvin-Voigt contact force whose damping rises as in the multibody code ADAMS (Ryan, 1990).

    Use it where the touchdown bearing is part of the run: `Scenario(stop=plants.Stop(1e7))`.
    """

    stiffness: Scalar = leaf(unit="N/m", at_least=1.0, at_most=1e12, doc="stiffness of the touchdown bearing")
    damping: Scalar = bounded(0.0, "N s/m", 0, 1e9, "damping of the touchdown bearing")

    def force(self, motion: Measurement, gap: Scalar) -> Array:
        """Return the force on the rotor, N. `motion`: true motion. `gap`: |z| at which the stop begins, m."""
        side = jnp.where(motion.z < 0, -1.0, 1.0)
        depth = jnp.maximum(side * motion.z - gap, 0.0)
        x = jnp.minimum(depth / (DAMPING_DEPTH * gap), 1.0)
        share = x * x * (3 - 2 * x)
        return -side * jnp.maximum(self.stiffness * depth + self.damping * share * (side * motion.z_dot), 0.0)

    def slope(self, m: Scalar) -> Scalar:
        """Return an upper bound of the magnitude of the poles of a rotor of mass m (kg) on the stop, 1/s."""
        return (self.stiffness / m) ** 0.5 + self.damping / m
