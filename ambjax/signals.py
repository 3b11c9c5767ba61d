"""Signals: pytrees that are functions of time. References and disturbances are one concept.

Call a signal with a time in seconds. A jump counts from its instant on (right-continuous).
"""

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from ambjax._pytree import Scalar, leaf, record


class Signal(Protocol):
    """Anything that maps a time in seconds to a value."""

    def __call__(self, t: Scalar, /) -> Array: ...


@record
class Constant:
    """The same value at all times."""

    value: Scalar = leaf(default=0.0, doc="the value")

    def __call__(self, t: Scalar) -> Array:
        return self.value + 0.0 * jnp.asarray(t)


@record
class Step:
    """0 before `start`, `amplitude` from then on."""

    amplitude: Scalar = leaf(doc="height")
    start: Scalar = leaf(default=0.0, unit="s", doc="when it rises")

    def __call__(self, t: Scalar) -> Array:
        return jnp.where(jnp.asarray(t) >= self.start, self.amplitude, 0.0)


@record
class Pulse:
    """`amplitude` in start <= t < stop, 0 elsewhere."""

    amplitude: Scalar = leaf(doc="height")
    start: Scalar = leaf(unit="s", doc="when it rises")
    stop: Scalar = leaf(unit="s", doc="when it falls; later than start")

    def __call__(self, t: Scalar) -> Array:
        t = jnp.asarray(t)
        return jnp.where((t >= self.start) & (t < self.stop), self.amplitude, 0.0)


@record
class Sine:
    """amplitude sin(2 pi frequency t + phase)."""

    amplitude: Scalar = leaf(doc="half the peak-to-peak height")
    frequency: Scalar = leaf(unit="Hz", at_least=0, doc="frequency")
    phase: Scalar = leaf(default=0.0, unit="rad", doc="phase at t = 0")

    def __call__(self, t: Scalar) -> Array:
        return self.amplitude * jnp.sin(2 * jnp.pi * self.frequency * jnp.asarray(t) + self.phase)


@record
class SmoothStep:
    """0 until `start`, then 10 s^3 - 15 s^4 + 6 s^5 of the way over `duration`: twice differentiable (C2)."""

    amplitude: Scalar = leaf(doc="height reached")
    start: Scalar = leaf(default=0.0, unit="s", doc="when it begins to rise")
    duration: Scalar = leaf(default=0.1, unit="s", above=0, doc="time it takes to rise")

    def __call__(self, t: Scalar) -> Array:
        s = (jnp.asarray(t) - self.start) / self.duration
        rising = s**3 * (10 - 15 * s + 6 * s**2)
        return self.amplitude * jnp.where(s <= 0, 0.0, jnp.where(s >= 1, 1.0, rising))


@record
class Chirp:
    """A sine whose frequency moves linearly from `frequency` to `frequency_end` over `duration`, then stays."""

    amplitude: Scalar = leaf(doc="half the peak-to-peak height")
    frequency: Scalar = leaf(unit="Hz", at_least=0, doc="frequency at t = 0")
    frequency_end: Scalar = leaf(unit="Hz", at_least=0, doc="frequency from t = duration on")
    duration: Scalar = leaf(unit="s", above=0, doc="time of the sweep")

    def __call__(self, t: Scalar) -> Array:
        t = jnp.asarray(t)
        sweep = jnp.minimum(t, self.duration)
        gain = (self.frequency_end - self.frequency) / self.duration
        cycles = self.frequency * sweep + gain * sweep**2 / 2 + self.frequency_end * (t - sweep)
        return self.amplitude * jnp.sin(2 * jnp.pi * cycles)


@record
class Sum:
    """The sum of several signals."""

    terms: tuple[Signal, ...]

    def __call__(self, t: Scalar) -> Array:
        total = Constant(0.0)(t)
        for term in self.terms:
            total = total + term(t)
        return total


class Reference(NamedTuple):
    """A reference and its first three time derivatives: m, m/s, m/s^2, m/s^3."""

    r: Array
    r_dot: Array
    r_ddot: Array
    r_dddot: Scalar = 0.0

    def rate(self) -> "Reference":
        """Its time derivative, as far as it is known: what a law's output changes by if only time passes."""
        return Reference(self.r_dot, self.r_ddot, self.r_dddot, jnp.zeros_like(self.r))


def reference_at(signal: Signal, t: Scalar) -> Reference:
    """r and its derivatives of one definition, by nested forward differentiation.

    A jump contributes nothing to a derivative.
    """
    t = jnp.asarray(t, jnp.result_type(float))

    def first(s: Array) -> tuple[Array, Array]:
        return jax.jvp(signal, (s,), (jnp.ones_like(s),))

    def second(s: Array) -> tuple[Array, Array, Array]:
        (r, r_dot), (_, r_ddot) = jax.jvp(first, (s,), (jnp.ones_like(s),))
        return r, r_dot, r_ddot

    known, rates = jax.jvp(second, (t,), (jnp.ones_like(t),))
    return Reference(*known, rates[2])
