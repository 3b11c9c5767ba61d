"""Limits of the voltage and of the current of each coil, for a bearing with one switching amplifier per coil."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.numerics.smooth import limited


class CoilVoltages(NamedTuple):
    """Voltages of the coils relative to the bias, V. Upper coil: R i_0 + `upper`. Lower coil: R i_0 - `lower`."""

    upper: Scalar
    lower: Scalar


def difference(u: Array | CoilVoltages) -> Array:
    """Return half the difference of the voltages of the coils, V."""
    return jnp.asarray(u.upper + u.lower) / 2 if isinstance(u, CoilVoltages) else u


@record
class CoilLimits:
    """Limits of the amplifier of each coil; both coils have the same.

    The voltage of a coil is limited to +-u_max. At a limit of its current, a voltage that would move the current
    further beyond the limit is replaced by the voltage that holds the current constant. If that voltage is outside
    +-u_max, it is limited too, and the current moves beyond its limit.

    Use it where each coil has its own limit: `actuators.Amplifier(coil=actuators.CoilLimits(i_max=5.0))`.
    """

    u_max: Scalar | None = leaf(
        default=None, unit="V", at_least=1e-9, at_most=1e12, doc="limit of |R i_0 +- u| at a coil; none: no limit"
    )
    i_max: Scalar | None = leaf(
        default=None, unit="A", at_least=1e-9, at_most=1e6, doc="limit of a coil's |current|, with i_0; none: no limit"
    )
    unidirectional: bool = static(default=False, doc="whether the current of a coil cannot become negative")

    def differential(self, i_0: Scalar) -> Scalar | None:
        """Return the |i| (A) at which the current of a coil, i_0 + |i|, reaches i_max; None: no limit."""
        return None if self.i_max is None else self.i_max - i_0

    def reserve(self, bias: Scalar) -> Scalar:
        """Return the |u| (V) at which the voltage of a coil is at its limit. `bias`: R i_0, V."""
        return jnp.inf if self.u_max is None else self.u_max - bias

    def applied(self, plant: Any, state: Any, u: Array, q_i: Scalar = 0.0) -> CoilVoltages:
        """Return the voltages at the coils for the commanded voltages R i_0 + u and R i_0 - u (V).

        `plant`: a `TwoCoil`. `state`: of the plant. `q_i`: disturbance of the current's rate, A/s.
        """
        bias = plant.R * plant.i_0
        voltages = self._limited(u, bias), self._limited(-u, bias)
        if self.i_max is not None or self.unidirectional:
            # the rate of each current is an affine function of its own voltage, and independent of the other voltage
            still, driven = (
                plant.currents(plant.rates(state, CoilVoltages(volt, -volt), 0.0, q_i)) for volt in (0.0, 1.0)
            )
            kept = (self._limited(-a / (b - a), bias) for a, b in zip(still, driven, strict=True))
            coils = zip(voltages, kept, plant.currents(state), strict=True)
            voltages = tuple(self._current_limited(*coil) for coil in coils)
        return CoilVoltages(voltages[0], -voltages[1])

    def supplied(self, u: Array, bias: Scalar) -> CoilVoltages:
        """Return the voltages R i_0 + u and R i_0 - u (V) within +-u_max. `bias`: R i_0, V."""
        return CoilVoltages(self._limited(u, bias), -self._limited(-u, bias))

    def _limited(self, volt: Array, bias: Scalar) -> Array:
        """Return `volt` (V), limited so that the coil's voltage, volt + bias, is within +-u_max. `bias`: R i_0, V."""
        if self.u_max is None:
            return volt
        return jnp.where(jnp.abs(volt + bias) > self.u_max, limited(volt + bias, self.u_max) - bias, volt)

    def _current_limited(self, volt: Array, kept: Array, i: Array) -> Array:
        """Return `volt` (V), or `kept` if the current i (A) of the coil is at a limit and `volt` would move it beyond.

        Both are voltages in excess of R i_0. `kept` (V) holds the current constant, as far as +-u_max allows.
        """
        if self.i_max is not None:
            volt = jnp.where((i >= self.i_max) & (volt > kept), kept, volt)
        least = 0.0 if self.unidirectional else -self.i_max if self.i_max is not None else -jnp.inf
        return jnp.where((i <= least) & (volt < kept), kept, volt)
