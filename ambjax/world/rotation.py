"""Unbalance and runout of a turning rotor, as functions of the angle, which is the integral of the speed."""

from typing import Any, ClassVar, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, leaf, part, record
from ambjax.numerics.smooth import TWO_PI, sine
from ambjax.world.waveforms import hull

# Hz per rpm; kg m per g mm; m per mm.
PER_MINUTE, GRAM_MM, MM = 1 / 60, 1e-6, 1e-3


def _speed() -> Any:
    return leaf(unit="rpm", at_least=0, at_most=1e7, doc="speed of the rotor at t = 0")


def _speed_end() -> Any:
    return leaf(
        default=None,
        unit="rpm",
        at_least=0,
        at_most=1e7,
        optional=True,
        doc="speed from t = duration on, after a linear run-up or run-down; none: constant speed",
    )


def _duration() -> Any:
    return leaf(default=1.0, unit="s", at_least=1e-9, at_most=1e9, doc="duration of the run-up")


def _phase() -> Any:
    return leaf(default=0.0, unit="rad", at_least=-1e9, at_most=1e9, doc="phase at t = 0")


class Turning(Protocol):
    """Protocol of a signal of a turning rotor: its speeds (rpm) and the duration of its run-up (s)."""

    @property
    def speed(self) -> Scalar: ...
    @property
    def speed_end(self) -> Scalar | None: ...
    @property
    def duration(self) -> Scalar: ...


def frequency(rotor: Turning, t: Scalar) -> Array:
    """Return the speed at time t (s), Hz."""
    t = jnp.asarray(t, jnp.result_type(float))
    if rotor.speed_end is None:
        return jnp.broadcast_to(jnp.asarray(rotor.speed * PER_MINUTE, t.dtype), t.shape)
    share = jnp.clip(t / rotor.duration, 0.0, 1.0)
    return PER_MINUTE * (rotor.speed + (rotor.speed_end - rotor.speed) * share)


def turns(rotor: Turning, t: Scalar) -> Array:
    """Return the angle at time t (s), in turns: the integral of the speed from 0 to t, in closed form."""
    t = jnp.asarray(t, jnp.result_type(float))
    if rotor.speed_end is None:
        return PER_MINUTE * rotor.speed * t
    sweep = jnp.minimum(t, rotor.duration)
    gain = (rotor.speed_end - rotor.speed) / rotor.duration
    return PER_MINUTE * (rotor.speed * sweep + gain * sweep**2 / 2 + rotor.speed_end * (t - sweep))


def _bound(rotor: Turning, size: Scalar) -> tuple[float, float]:
    """Return bounds of `size` omega^2 sin(...) over all speeds of the rotor. `size`: at least 0, in kg m or m."""
    fastest = rotor.speed if rotor.speed_end is None else np.maximum(rotor.speed, rotor.speed_end)
    peak = np.asarray(size) * (TWO_PI * PER_MINUTE * np.asarray(fastest)) ** 2
    return hull(-peak, peak)


@record
class Unbalance:
    """Force of an unbalance U, in N: U omega^2 sin(angle + phase).

    U is the unbalance mass times its distance from the axis. omega is the speed in rad/s; the angle is its integral.
    The speed is constant, or changes linearly from `speed` to `speed_end` in `duration`. The force due to the angular
    acceleration is neglected.
    """

    unbalance: Scalar = leaf(
        unit="g mm", at_least=0, at_most=1e9, doc="unbalance mass times its distance from the axis"
    )
    speed: Scalar = _speed()
    speed_end: Scalar | None = _speed_end()
    duration: Scalar = _duration()
    phase: Scalar = _phase()
    unit: ClassVar = "N"

    def __call__(self, t: Scalar) -> Array:
        omega = TWO_PI * frequency(self, t)
        return GRAM_MM * self.unbalance * omega**2 * sine(turns(self, t) + self.phase / TWO_PI)

    def span(self, end: float) -> tuple[float, float]:
        return _bound(self, GRAM_MM * self.unbalance)

    def edges(self) -> tuple[Scalar, ...]:
        """Return the end of the run-up, s, where the slope of the speed jumps; empty without a run-up."""
        return () if self.speed_end is None else (self.duration,)


@record
class UnbalanceGrade:
    """Acceleration of a rotor with the unbalance of a balance quality grade, in m/s^2: e omega^2 sin(angle + phase).

    The grade G is the product of the eccentricity e and the service speed, so e = G / (2 pi `service_speed` / 60); the
    grade G 2.5 of ISO 21940-11 is 2.5 mm/s. The unbalance is e times the mass of the rotor, so the acceleration does
    not depend on the mass. omega and the angle are those of `Unbalance`.
    """

    grade: Scalar = leaf(unit="mm/s", at_least=0, at_most=1e5, doc="balance quality grade; G 2.5 is 2.5 mm/s")
    service_speed: Scalar = leaf(unit="rpm", at_least=1e-3, at_most=1e7, doc="speed for which the grade is given")
    speed: Scalar = _speed()
    speed_end: Scalar | None = _speed_end()
    duration: Scalar = _duration()
    phase: Scalar = _phase()
    unit: ClassVar = "m/s^2"

    @property
    def eccentricity(self) -> Scalar:
        """Eccentricity e of the rotor, m."""
        return MM * self.grade / (TWO_PI * PER_MINUTE * self.service_speed)

    def __call__(self, t: Scalar) -> Array:
        omega = TWO_PI * frequency(self, t)
        return self.eccentricity * omega**2 * sine(turns(self, t) + self.phase / TWO_PI)

    def span(self, end: float) -> tuple[float, float]:
        return _bound(self, self.eccentricity)

    def edges(self) -> tuple[Scalar, ...]:
        """Return the end of the run-up, s, where the slope of the speed jumps; empty without a run-up."""
        return () if self.speed_end is None else (self.duration,)


@record
class Harmonic:
    """One harmonic of a runout, in m: amplitude sin(number angle + phase)."""

    amplitude: Scalar = leaf(unit="m", at_least=-1.0, at_most=1.0, doc="amplitude, half of the peak-to-peak value")
    number: Scalar = leaf(default=1.0, at_least=1, at_most=1000, whole=True, doc="waves in one turn")
    phase: Scalar = _phase()


@record
class Runout:
    """Runout of the surface that a position sensor reads, in m: a sum of harmonics of the rotor's angle.

    The sensor reads the position plus the runout; low-pass and gain follow. The true position does not contain it.
    """

    speed: Scalar = _speed()
    harmonics: tuple[Harmonic, ...] = part(default=(), doc="the harmonics")
    speed_end: Scalar | None = _speed_end()
    duration: Scalar = _duration()

    def __call__(self, t: Scalar) -> Array:
        angle, total = turns(self, t), jnp.zeros_like(jnp.asarray(t, jnp.result_type(float)))
        for one in self.harmonics:
            total = total + one.amplitude * sine(one.number * angle + one.phase / TWO_PI)
        return total

    def span(self, end: float) -> tuple[float, float]:
        most = sum(np.abs(np.asarray(one.amplitude)) for one in self.harmonics)
        return hull(-most, most)
