"""Signals: pytrees that are functions of time. References and disturbances are signals.

Call a signal with a time in seconds. Signals are right-continuous: at a jump the value is the later one. A random
signal has a method `realised(key)`, which draws the function of time for one member of an ensemble.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, bounded, is_traced, leaf, part, record
from ambjax.numerics.smooth import TWO_PI, sine

T = TypeVar("T")
# Fields of signals that are a frequency, and their factor to Hz.
FREQUENCIES = {"frequency": 1.0, "frequency_end": 1.0, "f_high": 1.0, "speed": 1 / 60, "speed_end": 1 / 60}


class Signal(Protocol):
    """Protocol of a signal: maps a time (s) to a value. `span` returns bounds of its values for times in 0..end (s).

    A signal with jumps or kinks also has `edges() -> tuple`, the times (s) at which it or a derivative jumps. A step of
    the integrator ends at each edge of a disturbance, and in continuous time also at each edge of the reference.
    """

    def __call__(self, t: Scalar, /) -> Array: ...
    def span(self, end: float, /) -> tuple[float, float]: ...


def hull(*values: Scalar | np.ndarray) -> tuple[float, float]:
    """Return the minimum and maximum of several numbers or arrays."""
    return float(min(map(np.min, values))), float(max(map(np.max, values)))


def later(signal: T, by: Scalar) -> T:
    """Return the signal, `by` seconds later."""
    return dataclasses.replace(signal, start=signal.start + by)  # pyright: ignore


def _swing(amplitude: Scalar, first: Scalar | np.ndarray, last: Scalar | np.ndarray) -> tuple[float, float]:
    """Return the minimum and maximum of amplitude sin(2 pi x) for x from `first` to `last` (turns)."""
    ends = [np.sin(TWO_PI * (x - np.floor(x))) for x in (first, last)]
    crest, trough = (np.ceil(first - at) <= last - at for at in (0.25, 0.75))
    high, low = np.where(crest, 1.0, np.maximum(*ends)), np.where(trough, -1.0, np.minimum(*ends))
    return hull(amplitude * low, amplitude * high)


@record
class Constant:
    """The same value at all times.

    Use it for a fixed position, or for a load such as the weight of a part:
    `Scenario(reference=signals.Constant(1e-4))`.
    """

    value: Scalar = bounded(0.0, "", -1e20, 1e20, "the value")

    def __call__(self, t: Scalar) -> Array:
        return jnp.broadcast_to(jnp.asarray(self.value, jnp.result_type(float)), jnp.shape(t))

    def span(self, end: float) -> tuple[float, float]:
        return hull(self.value)


@record
class Step:
    """0 before `start`, `amplitude` from then on.

    Use it for a load that is applied at once:
    `Scenario(q_f=signals.Step(5.0, start=0.1))`. A reference that moves the rotor should be smooth: see `SmoothStep`.
    """

    amplitude: Scalar = leaf(at_least=-1e20, at_most=1e20, doc="value after the jump")
    start: Scalar = bounded(0.0, "s", -1e9, 1e9, "time of the jump to `amplitude`")

    def __call__(self, t: Scalar) -> Array:
        return jnp.where(jnp.asarray(t) >= self.start, self.amplitude, 0.0)

    def span(self, end: float) -> tuple[float, float]:
        start = np.asarray(self.start)
        return hull(np.where(start > 0, 0.0, self.amplitude), np.where(start <= end, self.amplitude, 0.0))

    def edges(self) -> tuple[Scalar, ...]:
        return (self.start,)

    shifted = later


@record
class Pulse:
    """`amplitude` in start <= t < stop, 0 elsewhere.

    Use it for a short load, such as a shock: `Scenario(q_f=signals.Pulse(20.0, start=0.1, stop=0.102))`.
    """

    amplitude: Scalar = leaf(at_least=-1e20, at_most=1e20, doc="value from `start` to `stop`")
    start: Scalar = leaf(unit="s", at_least=-1e9, at_most=1e9, doc="time of the jump to `amplitude`")
    stop: Scalar = leaf(unit="s", at_least=-1e9, at_most=1e9, doc="time of the jump back to 0; later than `start`")
    ordered: ClassVar = ("start", "stop")

    def __call__(self, t: Scalar) -> Array:
        t = jnp.asarray(t)
        return jnp.where((t >= self.start) & (t < self.stop), self.amplitude, 0.0)

    def span(self, end: float) -> tuple[float, float]:
        start, stop = np.asarray(self.start), np.asarray(self.stop)
        on, off = (start <= end) & (stop > 0), (start > 0) | (stop <= end)
        return hull(np.where(on, self.amplitude, 0.0), np.where(off, 0.0, self.amplitude))

    def edges(self) -> tuple[Scalar, ...]:
        return (self.start, self.stop)

    def shifted(self, by: Scalar) -> "Pulse":
        return dataclasses.replace(self, start=self.start + by, stop=self.stop + by)


@record
class Sine:
    """amplitude sin(2 pi frequency t + phase).

    Use it for a periodic reference or load of known frequency:
    `Scenario(reference=signals.Sine(1e-4, 5.0))`. The load of an unbalance is `Unbalance`.
    """

    amplitude: Scalar = leaf(at_least=-1e20, at_most=1e20, doc="amplitude, half of the peak-to-peak value")
    frequency: Scalar = leaf(unit="Hz", at_least=0, at_most=1e9, doc="frequency")
    phase: Scalar = bounded(0.0, "rad", -1e9, 1e9, "phase at t = 0")

    def __call__(self, t: Scalar) -> Array:
        return self.amplitude * sine(self.frequency * jnp.asarray(t) + self.phase / TWO_PI)

    def span(self, end: float) -> tuple[float, float]:
        first = np.asarray(self.phase) / TWO_PI
        return _swing(self.amplitude, first, first + self.frequency * end)


@record
class Rise:
    """Base class of the signals that rise from 0 to `amplitude`."""

    amplitude: Scalar = leaf(at_least=-1e20, at_most=1e20, doc="final value")
    start: Scalar = bounded(0.0, "s", -1e9, 1e9, "start of the rise")
    duration: Scalar = bounded(0.1, "s", 1e-9, 1e9, "duration of the rise")

    @staticmethod
    def curve(s: Any) -> Any:
        """Return the share of the amplitude at the share s of the duration, 0 to 1."""
        raise NotImplementedError

    def span(self, end: float) -> tuple[float, float]:
        shares = [np.clip((t - np.asarray(self.start)) / self.duration, 0.0, 1.0) for t in (0.0, end)]
        return hull(*(self.amplitude * self.curve(s) for s in shares))

    def edges(self) -> tuple[Scalar, ...]:
        """Return the times at which the rise begins and ends, s."""
        return (self.start, self.start + self.duration)

    shifted = later


@record
class SmoothStep(Rise):
    """0 until `start`, a smooth rise over `duration`, then `amplitude`.

    During the rise, the value is amplitude (10 s^3 - 15 s^4 + 6 s^5) with s = (t - start)/duration. The signal has
    continuous first and second derivatives.

    Use it to move the rotor: `Scenario(reference=signals.SmoothStep(1e-4, start=0.1, duration=0.02))`.
    """

    @staticmethod
    def curve(s: Any) -> Any:
        return s**3 * (10 - 15 * s + 6 * s**2)

    def __call__(self, t: Scalar) -> Array:
        s = (jnp.asarray(t) - self.start) / self.duration
        rising = self.curve(s)
        return self.amplitude * jnp.where(s <= 0, 0.0, jnp.where(s >= 1, 1.0, rising))


@record
class Chirp:
    """A sine whose frequency changes linearly from `frequency` to `frequency_end` over `duration`, then stays.

    Use it to pass through a range of frequencies in one run:
    `Scenario(q_f=signals.Chirp(1.0, 10.0, 500.0, duration=2.0))`.
    """

    amplitude: Scalar = leaf(at_least=-1e20, at_most=1e20, doc="amplitude, half of the peak-to-peak value")
    frequency: Scalar = leaf(unit="Hz", at_least=0, at_most=1e9, doc="frequency at t = 0")
    frequency_end: Scalar = leaf(unit="Hz", at_least=0, at_most=1e9, doc="frequency from t = duration on")
    duration: Scalar = leaf(unit="s", at_least=1e-9, at_most=1e9, doc="duration of the sweep")

    def __call__(self, t: Scalar) -> Array:
        t = jnp.asarray(t)
        return self.amplitude * sine(jnp.asarray(self._cycles(t, jnp.minimum(t, self.duration))))

    def _cycles(self, t: Scalar, sweep: Scalar | np.ndarray) -> Scalar | np.ndarray:
        """Return the phase (turns) at time t; `sweep` is the time (s) spent in the sweep."""
        gain = (self.frequency_end - self.frequency) / self.duration
        return self.frequency * sweep + gain * sweep**2 / 2 + self.frequency_end * (t - sweep)

    def span(self, end: float) -> tuple[float, float]:
        return _swing(self.amplitude, 0.0, self._cycles(end, np.minimum(end, self.duration)))

    def edges(self) -> tuple[Scalar, ...]:
        """Return the end of the sweep, s, where the slope of the frequency jumps."""
        return (self.duration,)


@record
class Sum:
    """The sum of several signals.

    Use it where several loads act at once:
    `Scenario(q_f=signals.Sum((signals.Constant(10.0), signals.Sine(1.0, 50.0))))`.
    """

    terms: tuple[Signal, ...] = part(doc="the signals that are added")

    def __call__(self, t: Scalar) -> Array:
        total = Constant(0.0)(t)
        for term in self.terms:
            total = total + term(t)
        return total

    def span(self, end: float) -> tuple[float, float]:
        ends = [term.span(end) for term in self.terms]
        return sum(low for low, _ in ends), sum(high for _, high in ends)

    def edges(self) -> tuple[Scalar, ...]:
        return tuple(edge for term in self.terms for edge in edges_of(term))

    def knots(self) -> tuple[Any, ...]:
        return tuple(one for term in self.terms for one in knots_of(term))

    def realised(self, key: Array) -> "Sum":
        """Return the sum with its random terms drawn, each from a separate key."""
        return Sum(tuple(realised(term, jax.random.fold_in(key, n)) for n, term in enumerate(self.terms)))


def is_random(signal: Signal | None) -> bool:
    """Return whether the signal, or a term of it, is random."""
    return any(map(is_random, signal.terms)) if isinstance(signal, Sum) else hasattr(signal, "realised")


def realised(signal: Any, key: Array) -> Any:
    """Return the signal with its random terms drawn from `key`."""
    return signal.realised(key) if hasattr(signal, "realised") else signal


def edges_of(signal: Any) -> tuple[Scalar, ...]:
    """Return the times (s) at which the signal or a derivative jumps; empty if it is smooth."""
    return signal.edges() if hasattr(signal, "edges") else ()


def knots_of(signal: Any) -> tuple[Any, ...]:
    """Return the knots of a recorded signal, of type `recorded.Knots`; empty for other signals."""
    return signal.knots() if hasattr(signal, "knots") else ()


class Reference(NamedTuple):
    """A reference and its first three time derivatives: m, m/s, m/s^2, m/s^3."""

    r: Array
    r_dot: Array
    r_ddot: Array
    r_dddot: Scalar = 0.0

    def rate(self) -> "Reference":
        """Return the time derivative. The fourth derivative of the reference is taken as 0."""
        return Reference(self.r_dot, self.r_ddot, jnp.asarray(self.r_dddot), jnp.zeros_like(self.r))


def reference_at(signal: Signal, t: Scalar) -> Reference:
    """Return the reference and its three derivatives at a time, by nested forward differentiation.

    A jump does not contribute to a derivative.
    """
    t = jnp.asarray(t, jnp.result_type(float))

    def first(s: Array) -> tuple[Array, Array]:
        return jax.jvp(signal, (s,), (jnp.ones_like(s),))

    def second(s: Array) -> tuple[Array, Array, Array]:
        (r, r_dot), (_, r_ddot) = jax.jvp(first, (s,), (jnp.ones_like(s),))
        return r, r_dot, r_ddot

    (r, r_dot, r_ddot), (_, _, r_dddot) = jax.jvp(second, (t,), (jnp.ones_like(t),))
    return Reference(r, r_dot, r_ddot, r_dddot)


def frequencies_of(node: object) -> Iterator[tuple[str, float]]:
    """Yield the name and the largest value (Hz) of each frequency in a signal and its parts that has a number."""
    if isinstance(node, tuple):
        for item in node:
            yield from frequencies_of(item)
    elif dataclasses.is_dataclass(node):
        for field in dataclasses.fields(node):
            value = getattr(node, field.name)
            if field.name in FREQUENCIES and value is not None and not is_traced(value):
                yield field.name, FREQUENCIES[field.name] * float(np.max(np.asarray(value)))
            elif isinstance(value, tuple) or dataclasses.is_dataclass(value):
                yield from frequencies_of(value)
