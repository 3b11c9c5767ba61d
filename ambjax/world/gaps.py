"""The air gaps of the two magnets and the singular curve C, Eq. (9)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import compiled_alone
from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import safe_sqrt

# Lower bound of a gap in the divisions, as a share of s_0. The rotor is lost at a larger gap, so the bound acts only on
# trial stages of an integrator. It keeps the quotients and their derivatives finite.
GAP_FLOOR = 0.005


class Gaps(NamedTuple):
    """Upper gap (m), lower gap (m), and 1 / (upper lower) (1/m^2). All inverses use this one division."""

    upper: Array
    lower: Array
    inverse: Array

    @property
    def inverses(self) -> tuple[Array, Array]:
        """1 / upper gap and 1 / lower gap, in 1/m."""
        return self.lower * self.inverse, self.upper * self.inverse


def _product(z: Array, s_0: Array) -> Array:
    """Return the product of the gaps (m^2), at least its value where one gap is about GAP_FLOOR s_0."""
    product, least = s_0 * s_0 - z * z, 2 * GAP_FLOOR * s_0 * s_0
    return jnp.where(product > least, product, least)


def gaps(z: Scalar, s_0: Scalar) -> Gaps:
    """Return the gaps s_0 - z and s_0 + z (m). Only their inverses are bounded (GAP_FLOOR)."""
    z, s_0 = jnp.asarray(z), jnp.asarray(s_0)
    return Gaps(s_0 - z, s_0 + z, _inverse(z, s_0))


@jax.custom_jvp
@compiled_alone
def _inverse(z: Array, s_0: Array) -> Array:
    """Return 1 / (upper lower), 1/m^2, with the lower bound of `_product`."""
    return 1 / _product(z, s_0)


@_inverse.defjvp
def _inverse_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    value = _inverse(*primals)
    return value, jax.jvp(_product, primals, tangents)[1] * -(value * value)


def distance_to_C(zeta: Array, iota: Array) -> Array:
    """Return the distance from (zeta, iota) = (z/s_0, i/i_0) to the singular curve C, dimensionless. Eq. (9).

    In these coordinates C is iota = -(zeta + 1/zeta)/2, which has two branches. From starting points on both branches,
    Newton's method finds zeros of the derivative of the squared distance along C. The function returns the distance to
    the nearest of these zeros.
    """
    x = jnp.exp(jnp.linspace(-5.0, 5.0, 41))
    x = jnp.concatenate([x, -x])
    for _ in range(4):
        # d(distance^2)/dx times 2 x^3, a quartic in x. The bound on the relative step keeps x on its branch.
        value = 5 * x**4 + (2 * iota - 4 * zeta) * x**3 - 2 * iota * x - 1
        slope = 20 * x**3 + 3 * (2 * iota - 4 * zeta) * x**2 - 2 * iota
        x = x * (1 - jnp.clip(value / jnp.where(slope == 0, 1.0, slope) / x, -0.5, 0.5))
    return safe_sqrt(jnp.min((x - zeta) ** 2 + (iota + (x + 1 / x) / 2) ** 2))
