"""Peaks, delay margin and growth rate of a linearised loop as differentiable functions, for limits of the tuner.

The functions work under jit and vmap. `linear.analysis.analyse` computes the same numbers with NumPy, for reports.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax.linear.late_command import command_delay
from ambjax.linear.margins import DECAYED, STATIC
from ambjax.linear.state_space import NEUTRAL, StateSpace
from ambjax.numerics.records import Scalar

# Numbers of frequencies in the first scan, on a logarithmic axis: for peaks, and for crossings of |L| = 1.
POINTS, CROSSING_POINTS = 240, 240
# Rounds in which a frequency is refined, and points of a round. A round divides the spacing by (LOCAL - 1)/2 at a peak,
# and by LOCAL - 1 at a crossing.
ROUNDS, LOCAL = 4, 17
# Upper bound of the peaks of a stable loop, in the unit of each, and of 1/(pole times delay margin). The values of an
# unstable loop are at least as large.
MOST = 1e3
# Values of these quantities for a loop without an equilibrium, divided by MOST.
NO_EQUILIBRIUM = 100.0
# Delay margin of a loop without one, times the lowest frequency.
NONE = 1e12
# Step of the logarithm of the frequency in the difference quotient for the slope of L at a crossing.
SLOPE_STEP = 1e-4


class LoopQuantities(NamedTuple):
    """Quantities of a linearised loop. Values and derivatives are finite, except `growth` without an equilibrium.

    - `sensitivity`, `complementary`: peaks of |S| and |T|.
    - `control_sensitivity`: peak of |KS|, V/m.
    - `delay_margin_s`: smallest additional delay, at the position reading or at the command, that makes the loop
      unstable, s.
    - `sensitivity_1x`: the largest |S| at the speeds of the rotor.
    - `growth`: largest real part of a pole, 1/s; inf without an equilibrium. The loop is stable as in
      `StateSpace.stable`.

    The unit of |S| and |T| is 1, that of |KS| is `volts_per_metre`; `pole` is the unstable pole of the plant. For a
    stable loop, the peaks are those of `analyse`, smoothly limited to MOST times their unit. For an unstable loop they
    are MOST (1 + growth/pole) times their unit, so that a descent leads to a stable loop. The same holds for
    1/(pole times delay margin).
    """

    sensitivity: Array
    complementary: Array
    control_sensitivity: Array
    delay_margin_s: Array
    sensitivity_1x: Array
    growth: Array


class _Loop(NamedTuple):
    """S and KS of a loop by poles and zeros, without derivatives.

    - `system`: the loop, scaled.
    - `poles`, `zeros` [N]: of S.
    - `zeros_u` [N]: zeros of 1 + (KS - D)/`unit` with the direct feedthrough D of KS, whose poles are those of S.
    - `unit`: unit of KS, V/m.
    - `poles_in_s` [N]: poles in 1/s.
    """

    system: StateSpace
    poles: Array
    zeros: Array
    zeros_u: Array
    unit: Array
    poles_in_s: Array

    def responses(self, f: Array) -> tuple[Array, Array]:
        """Return S and KS [F], complex, at frequencies [F] in Hz."""
        at = self.system.point(f)[:, None]
        S = jnp.prod((at - self.zeros) / (at - self.poles), -1)
        KS = self.unit * (jnp.prod((at - self.zeros_u) / (at - self.poles), -1) - 1) + self.system.D[2, 0]
        return S, KS

    def transfer(self, f: Array) -> Array:
        """Return L = 1/S - 1 [F]."""
        return 1 / self.responses(f)[0] - 1


def loop_quantities(
    system: StateSpace,
    found: Array,
    low: Scalar,
    pole: Scalar,
    volts_per_metre: Scalar,
    *,
    delay: bool = True,
    speeds: Array | None = None,
) -> LoopQuantities:
    """Return the quantities of a loop from the matrices of `loop_matrices`.

    - `found`: whether the loop has an equilibrium.
    - `low`: lowest frequency of the peaks, Hz, besides 0. The highest is that of `margins.whole_end`, so that no change
      of the gains moves a peak out of the range.
    - `pole`: unstable pole of the plant, 1/s.
    - `volts_per_metre`: unit of |KS|, V/m.
    - `delay`: whether the delay margin is computed; if not, it is inf.
    - `speeds`: speeds [F] of the rotor, Hz. None: `sensitivity_1x` is 0.

    The frequency of each peak is found without derivatives, from the poles and zeros of the loop. The derivative of a
    peak is that of the response at this frequency (envelope theorem). The derivative of the delay margin is that of the
    implicit equation L = -1.
    """
    fine = found & jnp.all(jnp.asarray([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(system)]))
    n = len(system.A)
    safe = 0.5 * jnp.eye(n, dtype=system.A.dtype) * (1.0 if system.period is not None else -1.0)
    scaled = system.scaled()
    scaled = scaled._replace(
        A=jnp.where(fine, _without_idle(scaled), safe),
        **{name: jnp.where(fine, getattr(scaled, name), 0.0) for name in "BC"},
        path=jax.tree.map(lambda x: jnp.where(fine, x, 0.0), scaled.path),
    )
    growth, loop = _growth_and_loop(scaled, jnp.asarray(volts_per_metre))
    poles = loop.poles
    high = _whole_end(loop)
    f = _frequencies(loop, low, high)
    S, KS = loop.responses(f)
    peaks = [
        _refined(loop, f, size, low, high, which)
        for which, size in enumerate((jnp.abs(S), jnp.abs(S - 1), jnp.abs(KS)))
    ]
    response = scaled.response(jnp.stack(peaks))
    heights = jnp.abs(response[0, 0, 0]), jnp.abs(response[1, 0, 0] - 1), jnp.abs(response[2, 2, 0])
    margin = jnp.asarray(jnp.inf)
    if delay:
        end = jnp.maximum(100 * jnp.max(jnp.abs(loop.poles_in_s)) / (2 * jnp.pi), 2 * low)
        f = jnp.geomspace(low, high if system.period is not None else end, CROSSING_POINTS)
        margin = jnp.minimum(jnp.minimum(_delay_margin(scaled, loop, f), command_delay(scaled, f)), NONE / low)
    running = None if speeds is None else jnp.max(jnp.abs(scaled.response(speeds)[:, 0, 0]))
    fastest = jnp.max(jnp.abs(poles)) if system.period is None else 1 / system.period
    stable = fine & (growth < NEUTRAL * fastest)
    worse = MOST * jnp.where(fine, 1 + jnp.maximum(growth, 0.0) / pole, NO_EQUILIBRIUM)

    def bounded(x: Array) -> Array:
        """Return x > 0 smoothly limited to MOST. At x = 3 the relative change is 2e-11."""
        return jnp.where(stable, (jnp.maximum(x, 1e-12) ** -4 + MOST**-4) ** -0.25, worse)

    return LoopQuantities(
        bounded(heights[0]),
        bounded(heights[1]),
        loop.unit * bounded(heights[2] / loop.unit),
        1 / (pole * bounded(1 / (margin * pole))) if delay else margin,
        jnp.zeros(()) if running is None else bounded(running),
        jnp.where(fine, growth, jnp.inf),
    )


def _without_idle(system: StateSpace) -> Array:
    """Return A with a stable mode, which nothing excites, in place of each state that no input reaches."""
    idle = jnp.asarray(system.idle())
    rate = jnp.zeros(()) if system.period is not None else -jnp.max(jnp.abs(jnp.diagonal(system.A)))
    return jnp.where(idle[:, None], rate * jnp.eye(len(system.A), dtype=system.A.dtype), system.A)


def _growth_and_loop(system: StateSpace, unit: Array) -> tuple[Array, _Loop]:
    """Return the largest real part of the poles of a scaled system, 1/s, and its poles and zeros without derivatives.

    The zeros follow from det(zI - A + b c)/det(zI - A) = 1 + c (zI - A)^-1 b. `unit`: of KS, V/m. One call of LAPACK
    computes all eigenvalues (see `small_matrices`).

    The derivative of the dominant pole is that of a simple eigenvalue, from its left and right eigenvectors. JAX's
    derivative of `eig` requires independent eigenvectors of all poles. A delay adds a defective pole at
    z = 0, whose eigenvectors are dependent.
    """
    fixed = lax.stop_gradient(system)
    A, b = fixed.A, fixed.B[:, :1]
    every = jnp.stack([A, A - b * fixed.C[0][None], A - b * (fixed.C[2] / unit)[None]])
    values, left, right = lax.linalg.eig(every, compute_left_eigenvectors=True, compute_right_eigenvectors=True)
    poles, zeros, zeros_u = values
    in_s = poles if system.period is None else jnp.log(jnp.where(jnp.abs(poles) > 1e-9, poles, 1.0)) / system.period
    loop = _Loop(fixed, poles, zeros, zeros_u, unit, in_s)
    k = jnp.argmax(jnp.real(poles) if system.period is None else jnp.abs(poles))
    u, v = jnp.conj(left[0, :, k]), right[0, :, k]
    pole = poles[k] + u @ ((system.A - A) @ v) / (u @ v)
    if system.period is None:
        return jnp.real(pole), loop
    squared = jnp.real(pole) ** 2 + jnp.imag(pole) ** 2
    return 0.5 * jnp.log(jnp.maximum(squared, 1e-300)) / system.period, loop


def _whole_end(loop: _Loop) -> Array:
    """Return `margins.whole_end` (Hz)."""
    if (period := loop.system.period) is not None:
        return 0.5 / period
    total = jnp.sum(jnp.abs(loop.poles)) + jnp.sum(jnp.abs(loop.zeros))
    return (1 + DECAYED) * total / math.log1p(DECAYED) / (2 * jnp.pi)


def _frequencies(loop: _Loop, low: Scalar, high: Scalar) -> Array:
    """Return the frequencies (Hz) of the first scan: STATIC * low (for 0), a grid, and the frequencies of poles."""
    grid = jnp.geomspace(low, high, POINTS)
    own = jnp.clip(jnp.abs(jnp.imag(loop.poles_in_s)) / (2 * jnp.pi), low, high)
    return jnp.concatenate([jnp.asarray([STATIC * low]), grid, own])


def _refined(loop: _Loop, f: Array, size: Array, low: Scalar, high: Scalar, which: int) -> Array:
    """Return the frequency (Hz) of the peak near the largest `size` [F] at the frequencies `f` [F]."""
    best, reach = f[jnp.argmax(size)], jnp.log(high / low) / (POINTS - 1)
    for _ in range(ROUNDS):
        near = best * jnp.exp(reach * jnp.linspace(-1, 1, LOCAL))
        # the frequency that stands for 0 is not refined
        near = jnp.where(best < low, best, jnp.clip(near, low, high))
        S, KS = loop.responses(near)
        best = near[jnp.argmax(jnp.abs((S, S - 1, KS)[which]))]
        reach = 2 * reach / (LOCAL - 1)
    return best


def _delay_margin(system: StateSpace, loop: _Loop, f: Array) -> Array:
    """Return the delay margin (s) at the reading: the smallest lag/(2 pi f) where |L| = 1, or inf. `f`: of the scan."""
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
    return jnp.where(jnp.any(crosses), delay, jnp.inf)


def _lag(L: Array) -> Array:
    """Return the phase lag, from 0 to 2 pi rad, that rotates L to the negative real axis."""
    return jnp.pi + jnp.angle(L)
