"""The sliding variable, the scaled force for a wanted acceleration, and the scaled force of a linear magnet."""

from typing import Any, NamedTuple

from jax import Array

from ambjax.numerics.records import Scalar
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference


def sliding_variable(c: Scalar, motion: Measurement, reference: Reference) -> Array:
    """Return the sliding variable sigma = e_z_dot + c e_z (m/s), with e_z = z - r (Section 3.2)."""
    return motion.z_dot - reference.r_dot + c * (motion.z - reference.r)


def sigma_by_c(self: Any, motion: Measurement, reference: Reference) -> Array:
    """Return `sigma` of a law with the rate `c` on its sliding manifold: e_dot + c e."""
    return sliding_variable(self.c, motion, reference)


def sigma_by_gains(self: Any, motion: Measurement, reference: Reference) -> Array:
    """Return `sigma` of a law with the gains k_p and k_d: e_dot + (k_p/k_d) e, the error that the feedback removes."""
    return sliding_variable(self.k_p / self.k_d, motion, reference)


def sigma_size(self: Any, model: Plant) -> Scalar:
    """Return `size` of a law whose sign has the argument sigma, m/s."""
    return model.sigma_size


def force_for(c: Scalar, model: Plant, motion: Measurement, reference: Reference, robust: Scalar) -> Array:
    """Return the scaled force (A^2/m^2) that gives sigma_dot = `robust` (m/s^2) on the nominal plant. Eqs. (4), (5)."""
    wanted = -2 * model.k_z / model.m * motion.z - c * (motion.z_dot - reference.r_dot)
    return (wanted + reference.r_ddot + model.g + robust) * (1 / model.a)


class LinearMechanics(NamedTuple):
    """Coefficients of z_ddot = s z + b i - g, Eq. (1) linearised at z = 0, i = 0: s in 1/s^2, b in m/s^2/A."""

    s: Scalar
    b: Scalar


def linear_mechanics(model: Plant) -> LinearMechanics:
    """Return s = a dv/dz + 2 k_z/m and b = a dv/di, both derivatives at z = 0, i = 0."""
    dv_dz, dv_di = 4 * model.i_0**2 / model.s_0**3, 4 * model.i_0 / model.s_0**2
    return LinearMechanics(model.a * dv_dz + 2 * model.k_z / model.m, model.a * dv_di)


def resting_current(model: Plant, reference: Reference) -> Array:
    """Return the current (A) that keeps the linearised rotor on the reference: (r_ddot + g - s r)/b."""
    s, b = linear_mechanics(model)
    return (reference.r_ddot + model.g - s * reference.r) * (1 / b)


def force_of_current(model: Plant, z: Array, i: Array) -> Array:
    """Return the scaled force dv/dz z + dv/di i (A^2/m^2) of the magnets linearised at the origin.

    For this demand `inversion.Linearised` returns the current i itself.
    """
    s, b = linear_mechanics(model)
    return (s - 2 * model.k_z / model.m) / model.a * z + b / model.a * i
