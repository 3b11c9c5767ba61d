"""The amplifier between the commanded voltage and the coils: bandwidth, slew rate, dead band and current limit."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record
from ambjax.numerics.smooth import limited


@record
class Amplifier:
    """Response of an amplifier to a held voltage: u_a' = w (u - u_a), w = 2 pi bandwidth, |u_a'| at most `slew`.

    The dead band (from the dead time of a bridge) is subtracted from |u_a|. At the current limit, a voltage that would
    increase |i| is reduced to the voltage that holds i, or to the limit of the supply if that is smaller; |i| then
    exceeds its limit. A parameter left out is ideal.
    """

    bandwidth: Scalar | None = leaf(
        default=None, unit="Hz", at_least=1, at_most=1e6, optional=True, doc="first order; none: no lag"
    )
    slew: Scalar | None = leaf(
        default=None, unit="V/s", at_least=1e-3, at_most=1e15, optional=True, doc="largest rate of u; none: no limit"
    )
    dead_band: Scalar | None = leaf(
        default=None, unit="V", at_least=0, at_most=1e12, optional=True, doc="subtracted from |u|; none: 0"
    )
    i_max: Scalar | None = leaf(
        default=None, unit="A", at_least=1e-9, at_most=1e6, optional=True, doc="limit of |i|; none: no limit"
    )

    @property
    def slow(self) -> bool:
        """Whether the output voltage is a state: bandwidth or slew rate is limited."""
        return self.bandwidth is not None or self.slew is not None

    def slope(self) -> Scalar:
        """The rate w of the output voltage, 1/s; 0 if it follows immediately."""
        return 0.0 if self.bandwidth is None else 2 * jnp.pi * self.bandwidth

    def ramp(self, u_a: Array, u: Array) -> Array:
        """Return the time (s) for which the slew rate limits the voltage on its way from u_a to u."""
        if self.slew is None:
            return jnp.zeros_like(u)
        return jnp.maximum(jnp.abs(u - u_a) / self.slew - self._tail(), 0.0)

    def followed(self, u_a: Array, u: Array, time: Scalar) -> Array:
        """Return the output voltage (V) after `time` (s), from u_a (V), under a constant command u (V). Exact."""
        left, ramp = jnp.abs(u_a - u), self.ramp(u_a, u)
        if self.slew is not None:
            left = left - self.slew * jnp.minimum(ramp, time)
        later = jnp.maximum(time - ramp, 0.0)
        decay = jnp.where(later > 0, 0.0, 1.0) if self.bandwidth is None else jnp.exp(-self.slope() * later)
        return u + jnp.where(u_a > u, left, -left) * decay

    def _tail(self) -> Scalar:
        """Return the duration (s) of the final first-order part, in which the rate is below the slew rate."""
        return 0.0 if self.bandwidth is None else 1 / self.slope()

    def at_coil(self, u_a: Array, i: Array, u_max: Scalar, holding_voltage: Callable[[], Array]) -> Array:
        """Return the voltage (V) at the coils for a current i (A), within the supply's u_max (V).

        `holding_voltage`: returns the voltage (V) that holds that current.
        """
        if self.dead_band is not None:
            size = jnp.maximum(jnp.abs(u_a) - self.dead_band, 0.0)
            u_a = jnp.where(u_a < 0, -size, size)
        if self.i_max is None:
            return u_a
        kept = limited(holding_voltage(), u_max)
        u_a = jnp.where((i >= self.i_max) & (u_a > kept), kept, u_a)
        return jnp.where((i <= -self.i_max) & (u_a < kept), kept, u_a)
