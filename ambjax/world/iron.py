"""The iron of the magnets: saturation, leakage, and the lag of the flux by eddy currents in the laminations."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import compiled_alone, materialised
from ambjax.numerics.records import Scalar, bounded, record

# Smallest slope of the saturation curve: at large currents only the flux through the air still increases.
AIR = 0.02


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
    return 1 / jnp.sqrt(jnp.sqrt(1 + square * square))


@_inverse_root.defjvp
def _inverse_root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # all directions of a gradient share the slope, so it is computed once
    value = _inverse_root(*primals)
    x = primals[0] * value
    return value, materialised(-(x * x * x) * (value * value)) * tangents[0]
