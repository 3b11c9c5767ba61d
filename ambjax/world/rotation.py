"""Unbalance and runout of a turning rotor, as functions of the angle, which is the integral of the speed."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, bounded, leaf, part, record
from ambjax.numerics.smooth import TWO_PI, sine
from ambjax.world.waveforms import Sum, hull

# Hz per rpm; kg m per g mm; m per mm.
PER_MINUTE, GRAM_MM, MM = 1 / 60, 1e-6, 1e-3


def _rpm(at_least: float, doc: str, **more: Any) -> Any:
    return leaf(unit="rpm", at_least=at_least, at_most=1e7, doc=doc, **more)


def _phase() -> Any:
    return bounded(0.0, "rad", -1e9, 1e9, "phase of the sine at t = 0")


@record
class SpeedChange:
    """A change of the rate of a rotor's speed at an instant: a corner of a table of speeds."""

    at: Scalar = leaf(unit="s", at_least=0, at_most=1e9, doc="instant of the change")
    by: Scalar = leaf(unit="rpm/s", at_least=-1e12, at_most=1e12, doc="rate after it minus rate before it")


@record
class Rotation:
    """Speed of a rotor over time. Its angle is the integral of the speed, and 0 at t = 0.

    All unbalances and the runout of a scenario share this angle.

    Use it to give all that turns one speed: `Scenario(rotor=signals.Rotation(3000.0))`.
    """

    speed: Scalar = _rpm(-1e7, "speed at t = 0")
    acceleration: Scalar = bounded(0.0, "rpm/s", -1e9, 1e9, "rate of the speed")
    speed_end: Scalar | None = _rpm(
        -1e7, "speed at which the run-up or run-down ends; none: it never ends", default=None
    )
    changes: tuple[SpeedChange, ...] = part(default=(), doc="later changes of the rate, of a table of speeds")

    def check(self, path: str) -> None:
        """Raise ValueError if the speed never reaches speed_end. `path`: dotted path, for the message."""
        if self.speed_end is not None and not (self.speed_end - self.speed) * self.acceleration > 0:
            raise ValueError(
                f"{path}.speed_end = {self.speed_end:g}: from speed = {self.speed:g} rpm, an acceleration of "
                f"{self.acceleration:g} rpm/s never leads to it. Change the sign of {path}.acceleration, or leave "
                "speed_end out."
            )

    def _end(self) -> tuple[Array, ...]:
        """Return the end of the run-up, s; empty if it never ends."""
        if self.speed_end is None:
            return ()
        still = self.acceleration == 0  # set so in the exported notch, whose speed is measured
        return (jnp.maximum((self.speed_end - self.speed) / jnp.where(still, 1.0, self.acceleration), 0.0),)

    def edges(self) -> tuple[Scalar, ...]:
        return (*self._end(), *(change.at for change in self.changes))

    def _sweep(self, t: Array) -> Array:
        """Return the time for which the speed has changed, s."""
        return jnp.minimum(t, *end) if (end := self._end()) else t

    def rpm(self, t: Scalar) -> Array:
        """Return the speed at time t (s), rpm."""
        t = jnp.asarray(t, jnp.result_type(float))
        rpm = self.speed + self.acceleration * self._sweep(t)
        return rpm + sum(change.by * jnp.maximum(t - change.at, 0.0) for change in self.changes)

    def omega(self, t: Scalar) -> Array:
        """Return the speed at time t (s), rad/s."""
        return TWO_PI * PER_MINUTE * self.rpm(t)

    def turns(self, t: Scalar) -> Array:
        """Return the angle at time t (s), in turns: the integral of the speed from 0 to t, in closed form."""
        t = jnp.asarray(t, jnp.result_type(float))
        sweep = self._sweep(t)
        turns = self.speed * t + self.acceleration * sweep * (t - sweep / 2)
        turns += sum(change.by * jnp.maximum(t - change.at, 0.0) ** 2 / 2 for change in self.changes)
        return PER_MINUTE * turns

    def fastest(self, end: Scalar) -> float:
        """Return the largest |speed| between 0 and `end` (s), rad/s."""
        return max(float(np.max(np.abs(self.omega(t)))) for t in self.corners(end))

    def corners(self, end: Scalar) -> tuple[Scalar, ...]:
        """Return 0, the changes before `end`, and `end`, s: |speed| is largest at one of them."""
        return (0.0, *(jnp.minimum(change.at, end) for change in self.changes), end)


def _rotation() -> Any:
    return part(default=None, doc="speed; None: that of the scenario")


def known(rotation: Rotation | None) -> Rotation:
    """Return a speed that must be given. Raises ValueError for None."""
    if rotation is None:
        raise ValueError("a turning load or runout has no speed: give Scenario(rotor=Rotation(speed)), or a rotation.")
    return rotation


def turned(node: Any, rotation: Rotation) -> Any:
    """Return a signal or a runout in which each part without a speed of its own has this one."""
    if isinstance(node, Sum):
        return Sum(tuple(turned(term, rotation) for term in node.terms))
    return dataclasses.replace(node, rotation=rotation) if getattr(node, "rotation", rotation) is None else node


class Turning:
    """Base class of the loads `size` omega^2 sin(angle + phase) of a turning rotor. `size`: at least 0, kg m or m."""

    size: Any
    phase: Scalar
    rotation: Rotation | None

    def __call__(self, t: Scalar) -> Array:
        rotation = known(self.rotation)
        omega = rotation.omega(t)
        return self.size * omega**2 * sine(rotation.turns(t) + self.phase / TWO_PI)

    def span(self, end: float) -> tuple[float, float]:
        peak = np.asarray(self.size) * known(self.rotation).fastest(end) ** 2
        return hull(-peak, peak)

    def edges(self) -> tuple[Scalar, ...]:
        """Return the end of the run-up, s, where the slope of the speed jumps; empty without such an end."""
        return known(self.rotation).edges()


@record
class Unbalance(Turning):
    """Force of an unbalance U, in N: U omega^2 sin(angle + phase).

    U is the unbalance mass times its distance from the axis. omega is the speed in rad/s; the angle is its integral.
    The force due to the angular acceleration is neglected.

    Use it where the unbalance in g mm is known:
    `Scenario(q_f=signals.Unbalance(120.0), rotor=signals.Rotation(3000.0))`.
    """

    unbalance: Scalar = leaf(
        unit="g mm", at_least=0, at_most=1e9, doc="unbalance mass times its distance from the axis"
    )
    phase: Scalar = _phase()
    rotation: Rotation | None = _rotation()
    unit: ClassVar = "N"

    @property
    def size(self) -> Scalar:
        return GRAM_MM * self.unbalance


@record
class UnbalanceGrade(Turning):
    """Acceleration of a rotor with the unbalance of a balance quality grade, in m/s^2: e omega^2 sin(angle + phase).

    The grade G is the product of the eccentricity e and the service speed, so e = G / (2 pi `service_speed` / 60); the
    grade G 2.5 of ISO 21940-11 is 2.5 mm/s. The unbalance is e times the mass of the rotor, so the acceleration does
    not depend on the mass. omega and the angle are those of `Unbalance`.

    Use it where only the balance quality is known:
    `Scenario(q_z=signals.UnbalanceGrade(2.5, 6000.0), rotor=signals.Rotation(3000.0))`.
    """

    grade: Scalar = leaf(unit="mm/s", at_least=0, at_most=1e5, doc="balance quality grade; G 2.5 is 2.5 mm/s")
    service_speed: Scalar = leaf(unit="rpm", at_least=1e-3, at_most=1e7, doc="speed for which the grade is given")
    phase: Scalar = _phase()
    rotation: Rotation | None = _rotation()
    unit: ClassVar = "m/s^2"

    @property
    def eccentricity(self) -> Scalar:
        """Eccentricity e of the rotor, m."""
        return MM * self.grade / (TWO_PI * PER_MINUTE * self.service_speed)

    size = eccentricity


@record
class Harmonic:
    """One harmonic of a runout, in m: amplitude sin(number angle + phase).

    Use it in a `Runout`: `sensors.Harmonic(2e-6)`.
    """

    amplitude: Scalar = leaf(unit="m", at_least=-1.0, at_most=1.0, doc="amplitude, half of the peak-to-peak value")
    number: Scalar = bounded(1.0, "", 1, 1000, "waves in one turn", whole=True)
    phase: Scalar = _phase()


@record
class Runout:
    """Runout of the surface that a position sensor reads, in m: a sum of harmonics of the rotor's angle.

    The sensor reads the position plus the runout; low-pass and gain follow. The true position does not contain it.

    Use it where the sensor reads a turned surface: `sensors.Sensor(runout=sensors.Runout((sensors.Harmonic(2e-6),)))`.
    """

    harmonics: tuple[Harmonic, ...] = part(default=(), doc="the harmonics")
    rotation: Rotation | None = _rotation()

    def __call__(self, t: Scalar) -> Array:
        angle, total = known(self.rotation).turns(t), jnp.zeros_like(jnp.asarray(t, jnp.result_type(float)))
        for one in self.harmonics:
            total = total + one.amplitude * sine(one.number * angle + one.phase / TWO_PI)
        return total

    def span(self, end: float) -> tuple[float, float]:
        most = sum(np.abs(np.asarray(one.amplitude)) for one in self.harmonics)
        return hull(-most, most)
