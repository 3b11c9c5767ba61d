"""The amplifier between the command and the coils, which applies a voltage or controls the current, and coil limits."""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, bounded, part, record, static
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

    u_max: Scalar | None = bounded(None, "V", 1e-9, 1e12, "limit of |R i_0 +- u| at a coil; none: no limit")
    i_max: Scalar | None = bounded(None, "A", 1e-9, 1e6, "limit of a coil's |current|, with i_0; none: no limit")
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
            still, driven = (plant.currents(plant.rates(state, CoilVoltages(v, -v), 0.0, q_i)) for v in (0.0, 1.0))
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


# Gives `still` (A/s) and `per_volt` (A/(V s)) of the rate of the current i at an instant: i' = still + per_volt u.
CoilResponse = Callable[[], tuple[Array, Array]]


@record
class Amplifier:
    """An amplifier that applies a voltage u_a: u_a' = w (u - u_a), w = 2 pi bandwidth, |u_a'| at most `slew`.

    The command u is constant for one sample. The dead band (from the dead time of a bridge) is subtracted from |u_a|.
    At the limit `i_max`, a voltage that would increase |i| is replaced by the voltage that keeps i constant. If the
    supply cannot provide that voltage, it provides its largest voltage, and |i| exceeds `i_max`. The limits `coil` of
    each coil act last; `i_max` and `coil` cannot be given together. A parameter that is None has no effect.

    Use it where bandwidth, slew rate or dead time of the drive matter:
    `Scenario(u_max=48.0, amplifier=actuators.Amplifier(bandwidth=2e3))`.
    """

    bandwidth: Scalar | None = bounded(None, "Hz", 1, 1e6, "bandwidth of the voltage, first order; none: no lag")
    slew: Scalar | None = bounded(None, "V/s", 1e-3, 1e15, "largest rate of u; none: no limit")
    dead_band: Scalar | None = bounded(None, "V", 0, 1e12, "subtracted from |u|; none: 0")
    i_max: Scalar | None = bounded(None, "A", 1e-9, 1e6, "limit of |i|; none: no limit")
    coil: CoilLimits | None = part(default=None, doc="limits of each coil of a `TwoCoil`; None: no limits")

    mode: ClassVar[str] = "voltage"

    def command_limit(self, u_max: Scalar) -> Scalar:
        """Return the limit of the commanded voltage (V), that of the supply."""
        return u_max

    def current_limit(self, i_0: Scalar) -> Scalar | None:
        """Return the limit of |i| (A) for the bias current i_0 (A); None: no limit."""
        return self.i_max if self.coil is None else self.coil.differential(i_0)

    @property
    def slow(self) -> bool:
        """Whether the output voltage is a state, because the bandwidth or the slew rate is limited."""
        return self.bandwidth is not None or self.slew is not None

    def linear(self) -> "Amplifier":
        """Return the amplifier without the effects that a linear system cannot contain."""
        return Amplifier(self.bandwidth)

    def slope(self) -> Scalar:
        """Return the rate w of the output voltage, 1/s; 0 if the bandwidth is not limited."""
        return 0.0 if self.bandwidth is None else 2 * jnp.pi * self.bandwidth

    def ramp(self, u_a: Array, u: Array) -> Array:
        """Return the time (s) for which the slew rate limits the voltage on its way from u_a to u."""
        if self.slew is None:
            return jnp.zeros_like(u)
        # the slew rate would cover the final first-order part in 1/w
        tail = 0.0 if self.bandwidth is None else 1 / self.slope()
        return jnp.maximum(jnp.abs(u - u_a) / self.slew - tail, 0.0)

    def followed(self, u_a: Array, u: Array, time: Scalar) -> Array:
        """Return the exact output voltage (V) after `time` (s), from u_a (V), under a constant command u (V)."""
        left, ramp = jnp.abs(u_a - u), self.ramp(u_a, u)
        if self.slew is not None:
            left = left - self.slew * jnp.minimum(ramp, time)
        later = jnp.maximum(time - ramp, 0.0)
        decay = jnp.where(later > 0, 0.0, 1.0) if self.bandwidth is None else jnp.exp(-self.slope() * later)
        return u + jnp.where(u_a > u, left, -left) * decay

    def at_coil(self, u_a: Array, i: Array, u_max: Scalar, response: CoilResponse) -> Array:
        """Return the voltage (V) at the coils for the output u_a (V) and a current i (A), within u_max (V)."""
        if self.dead_band is not None:
            size = jnp.maximum(jnp.abs(u_a) - self.dead_band, 0.0)
            u_a = jnp.where(u_a < 0, -size, size)
        if self.i_max is None:
            return u_a
        still, per_volt = response()
        kept = limited((0.0 - still) / per_volt, u_max)
        u_a = jnp.where((i >= self.i_max) & (u_a > kept), kept, u_a)
        return jnp.where((i <= -self.i_max) & (u_a < kept), kept, u_a)


@record
class CurrentAmplifier:
    """An amplifier that controls the current: i' = w (i_command - i), w = 2 pi bandwidth, within the supply's voltage.

    The amplifier measures the true current and applies the voltage u that gives this rate. u is the sum of R i, the
    voltage that the motion induces, and the inductive voltage for the rate w (i_command - i). The supply limits |u| to
    u_max; at this limit, the current follows more slowly. In the two-coil plant, i is half the difference of the two
    currents.

    Use it with `current.AmplifierCurrent`: `Scenario(u_max=48.0, amplifier=actuators.CurrentAmplifier(bandwidth=1e3))`.
    """

    bandwidth: Scalar = bounded(1e3, "Hz", 1, 1e6, "bandwidth of the current loop, first order")
    i_max: Scalar | None = bounded(None, "A", 1e-9, 1e6, "limit of the command; none: no limit")
    mode: ClassVar[str] = "current"
    slow: ClassVar[bool] = False
    coil: ClassVar[None] = None

    def linear(self) -> "CurrentAmplifier":
        return CurrentAmplifier(self.bandwidth)

    def slope(self) -> Scalar:
        return 2 * jnp.pi * self.bandwidth

    def command_limit(self, u_max: Scalar) -> Scalar:
        return jnp.inf if self.i_max is None else self.i_max

    def current_limit(self, i_0: Scalar) -> Scalar | None:
        return self.i_max

    def at_coil(self, command: Array, i: Array, u_max: Scalar, response: CoilResponse) -> Array:
        """Return the voltage (V) at the coils for a commanded current (A) and a current i (A), within u_max (V)."""
        still, per_volt = response()
        return limited((self.slope() * (command - i) - still) / per_volt, u_max)
