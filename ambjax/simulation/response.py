"""Amplitude and phase of signals at orders of the rotor's speed, settling time and overshoot, as folds.

Settling time and overshoot are differentiable in the gains. The derivative of the settling time is that of the instant
at which |z - r| crosses the band. The derivative of the overshoot is that of the sample with the largest excursion.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, bounded, leaf, part, record
from ambjax.numerics.small_matrices import solve
from ambjax.numerics.smooth import TWO_PI, larger, safe_sqrt, sine, smaller
from ambjax.simulation.folds import Ending
from ambjax.simulation.trajectory import Row, Span
from ambjax.world.rotation import Rotation

# Signals and their units, and orders: multiples of the speed.
SIGNALS, ORDERS = {"z": "m", "i": "A", "u": "V", "force": "N"}, (1, 2)
# Unit of each metric by name: amplitude of a signal at an order, and its phase.
UNITS = {f"{name}_{k}x_{kind}": kind for name, unit in SIGNALS.items() for k in ORDERS for kind in (unit, "deg")}
# A revolution counts as complete if this part of it is missing: the rounding error of an angle.
ROUNDED = 1e-9
# Smallest slope of a crossing, in bands per sample, which bounds the derivative of the settling time.
SLOWEST = 1e-3


class OrderCarry(NamedTuple):
    """Sums over the samples so far.

    - `now`, `whole`: sums of the products of each basis function, then of each signal, with each basis function; over
      all samples, and over those up to the last whole revolution.
    - `first`, `turns`: angle of the first sample, in turns, and number of whole revolutions since then; -1: no sample.
    - `last`, `fastest`: angle of the last sample, and the largest change between two samples, in turns.
    """

    now: Array
    whole: Array
    first: Array
    turns: Array
    last: Array
    fastest: Array


@record
class Orders:
    """Amplitude A and phase phi of a + sum of A cos(k angle + phi), k = 1 and 2: the least-squares fit to each signal.

    The fit extends over the whole revolutions from `after` (s) on, until the rotor is lost. It is exact for a signal
    that contains these orders alone. At a constant speed it equals the Fourier sums, if a revolution has a whole number
    of samples. Without a whole revolution, all results are 0. Those of an order whose frequency is not below half the
    sampling rate are 0 too, because samples do not resolve it; the fit then leaves this order out.
    """

    rotor: Rotation = part(doc="speed of the rotor")
    after: Scalar = bounded(0.0, "s", 0, 1e6, "start of the evaluation")

    def init(self) -> OrderCarry:
        zero, size = jnp.zeros((), jnp.result_type(float)), 1 + 2 * len(ORDERS)
        none = jnp.zeros((size + len(SIGNALS), size), zero.dtype)
        return OrderCarry(none, none, zero, -jnp.ones_like(zero), zero, zero)

    def update(self, carry: OrderCarry, row: Row, span: Span) -> OrderCarry:
        counts, angle = (row.t >= self.after) & row.alive, self.rotor.turns(row.t)
        first = jnp.where(carry.turns < 0, angle, carry.first)
        turns = jnp.where(counts, jnp.floor(jnp.abs(angle - first) + ROUNDED), carry.turns)
        waves = (x for k in ORDERS for x in (sine(k * angle + 0.25), sine(k * angle)))
        basis = jnp.stack([jnp.ones_like(angle), *waves])
        signals = jnp.stack([jnp.asarray(getattr(row, name)) for name in SIGNALS])
        more = jnp.concatenate([basis, signals])[:, None] * basis
        whole = jnp.where(turns > carry.turns, carry.now, carry.whole)
        advance = jnp.where(counts & (carry.turns >= 0), jnp.abs(angle - carry.last), 0.0)
        fastest = jnp.maximum(carry.fastest, advance)
        return OrderCarry(carry.now + jnp.where(counts, more, 0.0), whole, first, turns, angle, fastest)

    def result(self, carry: OrderCarry, ending: Ending) -> dict[str, Array]:
        """Return amplitude and phase by the names of UNITS."""
        # the last revolution is complete if the run ends with it
        turns = jnp.abs(self.rotor.turns(jnp.minimum(ending.duration, ending.lost_at)) - carry.first)
        sums = jnp.where(jnp.floor(turns + ROUNDED) > carry.turns, carry.now, carry.whole)
        found = (turns + ROUNDED >= 1) & (carry.turns >= 0)
        # the samples of the run distinguish a frequency from half the sampling rate if it is lower by half a period
        highest = 0.5 - jnp.where(found, carry.fastest / jnp.maximum(turns, 1.0) / 2, 0.0)
        orders = [found & (k * carry.fastest < highest) for k in ORDERS for _ in range(2)]
        fitted = jnp.stack([found, *orders])
        size = len(fitted)
        products = jnp.where(fitted[:, None] & fitted, sums[:size], jnp.eye(size, dtype=sums.dtype))
        x = solve(products[None], jnp.where(fitted, sums[size:], 0.0).T[None])[0]
        numbers = {}
        for n, (name, unit) in enumerate(SIGNALS.items()):
            for k in ORDERS:
                a, b = x[2 * k - 1, n], x[2 * k, n]
                still = (a == 0) & (b == 0)
                numbers[f"{name}_{k}x_{unit}"] = safe_sqrt(a * a + b * b)
                numbers[f"{name}_{k}x_deg"] = 360 / TWO_PI * jnp.arctan2(0.0 - b, jnp.where(still, 1.0, a))
        return numbers


# Three numbers that a fold carries.
Three = tuple[Array, Array, Array]


@record
class Settling:
    """Settling time, s: the time at which |z - r| last comes within `band` (m), interpolated between samples.

    It is 0 if |z - r| never leaves the band. If |z - r| is outside the band at the end of the run, the settling time is
    the duration of the run times the final |z - r|/band, so it is longer than the run.

    Carried: the time at which |z - r| last came within the band, s; the time of the last sample, s; |z - r| there, m.
    """

    band: Scalar = leaf(unit="m", above=0, at_most=1.0, doc="the band")

    def init(self) -> Three:
        zero = jnp.zeros((), jnp.result_type(float))
        return zero, zero, zero

    def update(self, carry: Three, row: Row, span: Span) -> Three:
        at, before, last = carry
        size = jnp.abs(row.z - row.r)
        fall = jnp.maximum(last - size, SLOWEST * self.band)
        share = jnp.minimum((last - self.band) / fall, 1.0)
        entered = (last > self.band) & (size <= self.band)
        return jnp.where(entered, before + (row.t - before) * share, at), row.t, size

    def result(self, carry: Three, ending: Ending) -> Array:
        at, _, last = carry
        return jnp.where(last > self.band, ending.duration * last / self.band, at)


@record
class Overshoot:
    """Overshoot, m: the largest excursion of z beyond the range of its initial value and of all earlier references.

    For a step of r it is the usual overshoot; for a rotor that is lifted to r = 0, the excursion beyond 0.

    Carried: the extremes of the initial z and of r so far, and the largest excursion of z beyond them, m.
    """

    def init(self) -> Three:
        zero = jnp.zeros((), jnp.result_type(float))
        return zero + jnp.inf, zero - jnp.inf, zero

    def update(self, carry: Three, row: Row, span: Span) -> Three:
        low, high, beyond = carry
        began = jnp.where(row.t <= 0, row.z, row.r)
        low = smaller(low, smaller(began, row.r))
        high = larger(high, larger(began, row.r))
        return low, high, larger(beyond, larger(row.z - high, low - row.z))

    def result(self, carry: Three, ending: Ending) -> Array:
        return carry[2]
