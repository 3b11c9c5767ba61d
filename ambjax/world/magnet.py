"""The magnets: air gaps, the singular curve C (Eq. (9)), and iron with saturation, leakage and eddy currents."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import compiled_alone, materialised
from ambjax.numerics.records import Scalar, bounded, record
from ambjax.numerics.smooth import refined_reciprocal, safe_sqrt

# Lower bound of a gap in the divisions, as a share of s_0. The rotor is lost at a larger gap, so the bound acts only on
# trial stages of an integrator. It keeps the quotients and their derivatives finite.
GAP_FLOOR = 0.005
# Smallest slope of the saturation curve: at large currents only the flux through the air still increases.
AIR = 0.02


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
    return refined_reciprocal(_product(z, s_0))


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


@record
class Iron:
    """Saturation, leakage and eddy currents of the iron. An effect whose parameter is None is left out.

    - Saturation. With the flux density b of ideal iron and x = b / saturation, the flux density of the core is
      b (AIR + (1 - AIR) (1 + x^4)^(-1/4)). It is 3 % below b at x = 0.6 and 16 % at x = 1. At x = 2 it is about
      `saturation`; for larger x it increases with the slope AIR.
      This smooth minimum of b and `saturation` replaces the measured curve of a material (Schweitzer and Maslen,
      Magnetic Bearings, 2009, section 3.1). Saturation reduces the flux of the gap by the same factor.
    - Leakage. A part of a coil's flux does not cross the gap, but takes a path of constant reluctance. `leakage` is the
      ratio of the flux of the coil to that of the gap at z = 0 (Meeker, Maslen and Noh, IEEE Trans. Magn. 32(5), 1996).
      Leakage increases the inductance and the flux of the core. It changes the force of a given current only through
      saturation, because the flux density of the core is higher.
    - Eddy currents. The flux of a coil follows its current with the time constant `eddy`. For a lamination of thickness
      d, it is d^2 sigma mu / 12, the first-order term of the diffusion of the flux (Zmood, Anand and Kirk, 1987). The
      voltage equations do not change.

    Use it where the core saturates or its eddy currents matter: `plants.TwoCoil(iron=plants.Iron(saturation=1.4))`.
    """

    saturation: Scalar | None = bounded(None, "T", 1e-3, 1e3, "flux density limit of the core")
    leakage: Scalar | None = bounded(None, "1", 1, 10, "flux of a coil over flux of its gap, z = 0")
    eddy: Scalar | None = bounded(None, "s", 1e-7, 1.0, "lag of the flux behind the current")

    def core(self, plant: Any, i: Scalar, inverse: Scalar) -> Array:
        """Return the flux density of a core without saturation, T: mu_0 n i/2 (1/gap + (leakage - 1)/s_0).

        `i`: current of the coil, A. `inverse`: 1 / gap, 1/m.
        """
        return plant.mu_0 * plant.n / 2 * i * (inverse + self.beside(plant))

    def beside(self, plant: Any) -> Scalar:
        """Return the term that the leakage path adds to 1 / gap in the flux of the core: (leakage - 1)/s_0, 1/m."""
        return 0.0 if self.leakage is None else (self.leakage - 1) / plant.s_0

    def share(self, b: Array) -> Array:
        """Return the flux as a share of the flux without saturation, whose density is b (T)."""
        return (
            jnp.ones_like(b) if self.saturation is None else AIR + (1 - AIR) * _inverse_root(b * (1 / self.saturation))
        )

    def slope(self, b: Array) -> Array:
        """Return the derivative of the flux density with respect to b (T), the flux density without saturation."""
        if self.saturation is None:
            return jnp.ones_like(b)
        r = _inverse_root(b * (1 / self.saturation))
        square = r * r
        return AIR + (1 - AIR) * (square * square * r)

    def following(self, i: Array, late: Array) -> Array:
        """Return the rate (A/s) of the delayed current `late` (A), which follows the current i (A)."""
        return jnp.zeros_like(i) if self.eddy is None else (i - late) * (1 / self.eddy)

    def fastest(self) -> Scalar:
        """Return the largest factor by which saturation increases the rate R/L of a coil's current."""
        return 1.0 if self.saturation is None else 1 / AIR


@jax.custom_jvp
@compiled_alone
def _inverse_root(x: Array) -> Array:
    """Return (1 + x^4)^(-1/4)."""
    square = x * x
    return refined_reciprocal(jnp.sqrt(jnp.sqrt(1 + square * square)))


@_inverse_root.defjvp
def _inverse_root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # all directions of a gradient share the slope, so it is computed once
    value = _inverse_root(*primals)
    x = primals[0] * value
    return value, materialised(-(x * x * x) * (value * value)) * tangents[0]
