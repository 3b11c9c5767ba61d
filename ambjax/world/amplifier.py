"""The amplifier between the commanded voltage and the coils: how fast, from where on, and up to which current."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record
from ambjax.numerics.smooth import limited


@record
class Amplifier:
    """What an amplifier makes of a voltage that is held: u_a' = w (u - u_a) with w = 2 pi bandwidth, at most `slew`.

    Then the dead band (of a bridge's dead time) is taken off its size, and at the current limit what would push the
    current further out is cut to what keeps it, or to the supply's end where the motion asks for more: the current then
    leaves its limit. What is left out is ideal.
    """

    bandwidth: Scalar | None = leaf(
        default=None, unit="Hz", at_least=1, at_most=1e6, optional=True, doc="first order; none: at once"
    )
    slew: Scalar | None = leaf(
        default=None, unit="V/s", at_least=1e-3, at_most=1e15, optional=True, doc="largest rate of u; none: no limit"
    )
    dead_band: Scalar | None = leaf(
        default=None, unit="V", at_least=0, at_most=1e12, optional=True, doc="taken off the size of u; none: 0"
    )
    i_max: Scalar | None = leaf(
        default=None, unit="A", at_least=1e-9, at_most=1e6, optional=True, doc="limit of |i|; none: no limit"
    )

    @property
    def slow(self) -> bool:
        """Whether its voltage follows the command with a state of its own."""
        return self.bandwidth is not None or self.slew is not None

    def slope(self) -> Scalar:
        """The rate w at which its voltage follows, 1/s; 0 if at once."""
        return 0.0 if self.bandwidth is None else 2 * jnp.pi * self.bandwidth

    def ramp(self, u_a: Array, u: Array) -> Array:
        """For how long the slew rate limits a voltage u_a on its way to u, s."""
        if self.slew is None:
            return jnp.zeros_like(u)
        return jnp.maximum(jnp.abs(u - u_a) / self.slew - self._tail(), 0.0)

    def followed(self, u_a: Array, u: Array, time: Scalar) -> Array:
        """Its voltage after `time` s, u_a (V) before, while u is commanded. Exact."""
        left, ramp = jnp.abs(u_a - u), self.ramp(u_a, u)
        if self.slew is not None:
            left = left - self.slew * jnp.minimum(ramp, time)
        later = jnp.maximum(time - ramp, 0.0)
        decay = jnp.where(later > 0, 0.0, 1.0) if self.bandwidth is None else jnp.exp(-self.slope() * later)
        return u + jnp.where(u_a > u, left, -left) * decay

    def _tail(self) -> Scalar:
        """How long the rate of the first order stays below the slew rate, in times of 1/w; s."""
        return 0.0 if self.bandwidth is None else 1 / self.slope()

    def at_coil(self, u_a: Array, i: Array, u_max: Scalar, holding_voltage: Callable[[], Array]) -> Array:
        """What of its voltage reaches the coils at a current of i (A), V: never beyond the supply's u_max (V).

        `holding_voltage`: what would keep that current, V.
        """
        if self.dead_band is not None:
            size = jnp.maximum(jnp.abs(u_a) - self.dead_band, 0.0)
            u_a = jnp.where(u_a < 0, -size, size)
        if self.i_max is None:
            return u_a
        kept = limited(holding_voltage(), u_max)
        u_a = jnp.where((i >= self.i_max) & (u_a > kept), kept, u_a)
        return jnp.where((i <= -self.i_max) & (u_a < kept), kept, u_a)
