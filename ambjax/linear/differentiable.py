"""Peaks, delay margin and stability of a linearised loop as differentiable functions, for limits of the tuner.

`analyse` computes the same numbers in NumPy, for reports. These run under jit and vmap and have derivatives.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from ambjax.linear.margins import STATIC
from ambjax.linear.state_space import StateSpace
from ambjax.numerics.records import Scalar

# Points of the first scan on a logarithmic axis, for peaks and for crossings of |L| = 1.
POINTS, CROSSING_POINTS = 120, 240
# Rounds of refinement of a frequency; each divides the spacing of the scan by half of the number of points.
ROUNDS, LOCAL = 4, 17
# Largest value of a stable loop, relative to the unit of the quantity. An unstable loop has this value or a larger one.
MOST = 1e3
# Value of a loop without an equilibrium, in units of MOST.
NO_EQUILIBRIUM = 100.0
# Step of the logarithm of the frequency in the slope of L at a crossing.
SLOPE_STEP = 1e-4


class LoopQuantities(NamedTuple):
    """Quantities of a linearised loop, with finite values and derivatives for every loop.

    - `sensitivity`, `complementary`: peaks of |S| and |T|. `control_sensitivity`: peak of |KS|, V/m.
    - `delay_margin_s`: smallest additional delay that makes the loop unstable, s.
    - `growth`: largest real part of a pole, 1/s; below 0 if the loop is stable.

    A stable loop has the values of `analyse`, up to MOST. With the growth rate a, relative to the plant's pole, an
    unstable loop has MOST (1 + a) times the unit: 1 for |S| and |T|, the voltage that moves the plant by its gap per
    gap for |KS|, and its inverse times the time constant of the plant's pole for the delay margin. So the derivative
    points to a stable loop.
    """

    sensitivity: Array
    complementary: Array
    control_sensitivity: Array
    delay_margin_s: Array
    growth: Array


class _Loop(NamedTuple):
    """A loop as poles and zeros [N]: S, and 1 + KS/`unit` - D; `poles_in_s` [N] in 1/s. Without derivatives."""

    poles: Array
    zeros: Array
    zeros_u: Array
    through: Array
    unit: Array
    period: Array | None
    poles_in_s: Array

    def responses(self, f: Array) -> tuple[Array, Array]:
        """Return S and KS [F], complex, at frequencies [F] in Hz."""
        at = _point(f, self.period)[:, None]
        S = jnp.prod((at - self.zeros) / (at - self.poles), -1)
        KS = self.unit * (jnp.prod((at - self.zeros_u) / (at - self.poles), -1) - 1) + self.through
        return S, KS

    def transfer(self, f: Array) -> Array:
        """Return L = 1/S - 1 [F]."""
        return 1 / self.responses(f)[0] - 1


def loop_quantities(
    system: StateSpace, found: Array, low: Scalar, high: Scalar, pole: Scalar, volts_per_metre: Scalar
) -> LoopQuantities:
    """Return the quantities of a loop from the matrices of `loop_matrices`.

    `found`: whether the loop has an equilibrium. `low`, `high` (Hz): range of the peaks; the static response is
    included. `pole` (1/s): of the plant. `volts_per_metre`: unit of |KS|. Each peak is searched without derivatives,
    from the poles and zeros of the loop; the derivative of a peak is that at its frequency (envelope theorem), and
    that of a crossing is implicit.
    """
    fine = found & jnp.all(jnp.asarray([jnp.all(jnp.isfinite(x)) for x in system if x is not None]))
    n = len(system.A)
    safe = 0.5 * jnp.eye(n, dtype=system.A.dtype) * (1.0 if system.period is not None else -1.0)
    scaled = system.scaled()
    scaled = scaled._replace(
        A=jnp.where(fine, scaled.A, safe), **{name: jnp.where(fine, getattr(scaled, name), 0.0) for name in "BC"}
    )
    growth, poles = _growth(scaled)
    loop = _loop(lax.stop_gradient(scaled), poles, jnp.asarray(volts_per_metre))
    f = _frequencies(loop, low, high)
    S, KS = loop.responses(f)
    peaks = [
        _refined(loop, f, size, low, high, which)
        for which, size in enumerate((jnp.abs(S), jnp.abs(S - 1), jnp.abs(KS)))
    ]
    response = scaled.response(jnp.stack(peaks))
    heights = jnp.abs(response[0, 0, 0]), jnp.abs(response[1, 0, 0] - 1), jnp.abs(response[2, 2, 0])
    delay = _delay_margin(scaled, loop, low)
    stable = fine & (growth < 0)
    worse = MOST * jnp.where(fine, 1 + jnp.maximum(growth, 0.0) / pole, NO_EQUILIBRIUM)

    def bounded(x: Array) -> Array:
        return jnp.where(stable, _capped(x), worse)

    return LoopQuantities(
        bounded(heights[0]),
        bounded(heights[1]),
        loop.unit * bounded(heights[2] / loop.unit),
        1 / (pole * bounded(1 / (delay * pole))),
        jnp.where(fine, growth, jnp.inf),
    )


def _point(f: Array, period: Array | None) -> Array:
    """Return s = 2 pi j f, or z = exp(s T) on a processor."""
    s = 2j * jnp.pi * f
    return s if period is None else jnp.exp(s * period)


def _capped(x: Array) -> Array:
    """Return x, smoothly limited to MOST: at x = 3 the relative difference is 2e-11."""
    return (jnp.maximum(x, 1e-12) ** -4 + MOST**-4) ** -0.25


def _growth(system: StateSpace) -> tuple[Array, Array]:
    """Return the largest real part of the poles in 1/s, and the poles [N] without derivatives.

    The derivative of the dominant pole is that of a simple eigenvalue, from its left and right eigenvectors. JAX's
    derivative needs the eigenvectors of all poles, which are not independent: delays have a defective pole at 0.
    """
    A = lax.stop_gradient(system.A)
    poles, left, right = lax.linalg.eig(A, compute_left_eigenvectors=True, compute_right_eigenvectors=True)
    k = jnp.argmax(jnp.real(poles) if system.period is None else jnp.abs(poles))
    u, v = jnp.conj(left[:, k]), right[:, k]
    pole = poles[k] + u @ ((system.A - A) @ v) / (u @ v)
    if system.period is None:
        return jnp.real(pole), poles
    squared = jnp.real(pole) ** 2 + jnp.imag(pole) ** 2
    return 0.5 * jnp.log(jnp.maximum(squared, 1e-300)) / system.period, poles


def _loop(system: StateSpace, poles: Array, unit: Array) -> _Loop:
    """Return poles and zeros of a scaled system: det(zI - A + b c)/det(zI - A) = 1 + c (zI - A)^-1 b."""
    A, b = system.A, system.B[:, :1]
    zeros, zeros_u = (
        lax.linalg.eig(A - b * row[None], compute_left_eigenvectors=False, compute_right_eigenvectors=False)[0]
        for row in (system.C[0], system.C[2] / unit)
    )
    in_s = poles if system.period is None else jnp.log(jnp.where(jnp.abs(poles) > 1e-9, poles, 1.0)) / system.period
    return _Loop(poles, zeros, zeros_u, system.D[2, 0], unit, system.period, in_s)


def _frequencies(loop: _Loop, low: Scalar, high: Scalar) -> Array:
    """Return the frequencies (Hz) of the first scan: one that stands for 0, a logarithmic grid, and those of poles."""
    grid = jnp.geomspace(low, high, POINTS)
    own = jnp.clip(jnp.abs(jnp.imag(loop.poles_in_s)) / (2 * jnp.pi), low, high)
    return jnp.concatenate([jnp.asarray([STATIC * low]), grid, own])


def _refined(loop: _Loop, f: Array, size: Array, low: Scalar, high: Scalar, which: int) -> Array:
    """Return the frequency of the peak near the largest of the sizes [F] at f [F]. `which`: 0: S, 1: T, 2: KS."""
    best, reach = f[jnp.argmax(size)], jnp.log(high / low) / (POINTS - 1)
    for _ in range(ROUNDS):
        near = best * jnp.exp(reach * jnp.linspace(-1, 1, LOCAL))
        # the static response has no neighbours
        near = jnp.where(best < low, best, jnp.clip(near, low, high))
        S, KS = loop.responses(near)
        best = near[jnp.argmax(jnp.abs((S, S - 1, KS)[which]))]
        reach = 2 * reach / (LOCAL - 1)
    return best


def _delay_margin(system: StateSpace, loop: _Loop, low: Scalar) -> Array:
    """Return the smallest lag (rad) over 2 pi f at the frequencies with |L| = 1; 1e12/low without such a frequency."""
    fastest = 100 * jnp.max(jnp.abs(loop.poles_in_s)) / (2 * jnp.pi)
    high = jnp.maximum(fastest, 2 * low) if system.period is None else 0.5 / system.period
    f = jnp.geomspace(low, high, CROSSING_POINTS)
    L = loop.transfer(f)
    size = jnp.log(jnp.abs(L))
    crosses = size[:-1] * size[1:] < 0
    delays = jnp.where(crosses, _lag(L[:-1]) / f[:-1], jnp.inf)
    k = jnp.argmin(delays)
    left, right = f[k], f[k + 1]
    for _ in range(ROUNDS):
        near = jnp.geomspace(left, right, LOCAL)
        along = jnp.log(jnp.abs(loop.transfer(near)))
        at = jnp.argmax(along[:-1] * along[1:] <= 0)
        left, right = near[at], near[at + 1]
    f0 = 0.5 * (left + right)
    L = 1 / system.response(f0 * jnp.exp(SLOPE_STEP * jnp.asarray([-1.0, 0.0, 1.0])))[:, 0, 0] - 1
    slope = jnp.log(L[2] / L[0]) / (2 * SLOPE_STEP)
    shift = -jnp.log(jnp.abs(L[1])) / jnp.real(slope)
    lag = _lag(L[1]) + jnp.imag(slope) * shift
    delay = lag / (2 * jnp.pi * f0 * jnp.exp(shift))
    return jnp.where(jnp.any(crosses), delay, 1e12 / low)


def _lag(L: Array) -> Array:
    """Return the phase lag (rad) that turns L to -1, from 0 to 2 pi."""
    return jnp.pi + jnp.angle(L)
