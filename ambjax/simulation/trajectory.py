"""Trajectories: one row per recorded sample, spans of signals between two samples, and the status of the rotor.

Under held noise, i_ref moves to a new value within microseconds after every sample, and the voltage is then at its
limit. Values at the samples show only the start of this transient. The integrator therefore evaluates the signals at
every substep, and returns their extremes and integrals as a `Span`.
"""

import pathlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ambjax.numerics.records import Scalar, record
from ambjax.numerics.smooth import larger, smaller

# Status codes of a rotor, for compiled code; the event of each status, its reason, and both as one text.
ALIVE, TOUCHED, DIVERGED, STALLED = range(4)
EVENTS = ("", "touched down", "diverged", "stalled")
# Reasons of the events, for messages. With an elastic stop, the limit of |z| is 0.99 s_0 instead of the clearance. A
# command or a reading that is not finite counts as a state out of range.
REASONS = (
    "",
    "|z| reached the clearance",
    "a state left the range in which the model is valid",
    "the integrator could not meet its tolerance",
)
STATUSES = tuple(f"{event}: {reason}" if event else "" for event, reason in zip(EVENTS, REASONS, strict=True))


class Row(NamedTuple):
    """Signals of a closed loop at one sample, in SI units. In a Trajectory every field has a leading time axis."""

    t: Array
    """time, s"""
    z: Array
    """rotor displacement, m"""
    z_dot: Array
    """rotor velocity, m/s"""
    i: Array
    """current deviation, A"""
    i_ref: Array
    """reference of the current deviation, A"""
    u: Array
    """voltage within the supply's limit (on a processor: the command, which acts after the delay; 0 once lost), V"""
    u_mean: Array
    """mean of the applied voltage over the sample that begins at t, including spikes shorter than a sample, V"""
    u_peak: Array
    """largest |voltage| at the coils over the sample (with an amplifier, u is its command), V"""
    i_1: Array
    """current of the upper coil, A"""
    i_2: Array
    """current of the lower coil, A"""
    force: Array
    """magnetic force, N"""
    B: Array
    """larger of the flux densities of the two cores, T"""
    v: Array
    """scaled magnetic force v(z, i), A^2/m^2. Eq. (3)"""
    v_star: Array
    """demanded scaled force, A^2/m^2. Eq. (5)"""
    v_tilde: Array
    """inversion error v_star - v(z, i_ref) as the controller computed it, A^2/m^2"""
    sigma: Array
    """sliding variable of the true motion, m/s"""
    r: Array
    """reference, m"""
    q_z: Array
    """total disturbance acceleration of Eq. (1): q_z, q_v, q_f and base, without the stop, m/s^2"""
    q_i: Array
    """disturbance of the current derivative, A/s"""
    z_measured: Array
    """displacement that the sensor reports (0 if it reports NaN), m"""
    heat: Array
    """copper loss in both coils, W"""
    refused: Array
    """whether the guard of the processor refused the reading, bool"""
    alive: Array
    """whether the rotor is held, bool"""
    z_stop: Array | tuple[()] = ()
    """displacement at the stop, m; (): the stop is at the magnet"""

    @property
    def e_z(self) -> Array:
        """Tracking error z - r, m."""
        return self.z - self.r

    @property
    def e(self) -> Array:
        """Current tracking error i - i_ref, A. Eq. (10)."""
        return self.i - self.i_ref


NOT_SAVED = ("u_peak", "heat", "alive", "z_stop")
# Unit of each saved signal.
SIGNAL_UNITS = {
    **dict.fromkeys(("z", "r", "z_measured"), "m"),
    **dict.fromkeys(("z_dot", "sigma"), "m/s"),
    **dict.fromkeys(("i", "i_ref", "i_1", "i_2"), "A"),
    **dict.fromkeys(("u", "u_mean"), "V"),
    **dict.fromkeys(("v", "v_star", "v_tilde"), "A^2/m^2"),
    **{"t": "s", "q_z": "m/s^2", "q_i": "A/s", "refused": "bool", "force": "N", "B": "T"},
}


@record
class Trajectory:
    """The recorded rows of a rollout, and the status of the rotor.

    - `rows`: a Row whose fields have a leading axis of recorded samples; None if no rows were recorded.
    - `lost_at`: time at which the rotor was lost or the integrator stalled, s; +inf: never.
    - `lost_code`: status code, an index of STATUSES; 0 if the rotor is held.
    - `singular_at`: time at which the singular curve C was first crossed, s; +inf: never.
    """

    rows: Row
    lost_at: Scalar
    lost_code: Scalar
    singular_at: Scalar

    @property
    def lost_why(self) -> str:
        """The event that ended the run and its reason, in words; empty if the rotor survives. For one member only."""
        return STATUSES[int(self.lost_code)]

    @property
    def lost_event(self) -> str:
        """The event that ended the run; empty if the rotor survives. For one member only."""
        return EVENTS[int(self.lost_code)]

    @property
    def lost_reason(self) -> str:
        """The reason of this event; empty if the rotor survives. For one member only."""
        return REASONS[int(self.lost_code)]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the saved arrays by name, float64, with the status."""
        arrays = {k: np.asarray(v, np.float64) for k, v in self.rows._asdict().items() if k not in NOT_SAVED}
        arrays["lost_at"] = np.asarray(self.lost_at, np.float64)
        arrays["lost_why"] = np.asarray(self.lost_why)
        arrays["singular_at"] = np.asarray(self.singular_at, np.float64)
        return arrays

    def save(self, path: str | pathlib.Path) -> None:
        """Write the arrays to an .npz file."""
        np.savez_compressed(path, **self.arrays())  # pyright: ignore[reportArgumentType]


def first_time(condition: Array, t: Scalar, earlier: Scalar) -> Array:
    """Return `earlier` if it is finite, else t if `condition` holds, else +inf."""
    return jnp.where(jnp.isfinite(earlier), earlier, jnp.where(condition, t, jnp.inf))


class Instant(NamedTuple):
    """Signals of a system at one instant, each a pytree of numbers, or empty.

    - `sizes`: signals for which a Span records the extremes of the absolute value.
    - `densities`: signals for which a Span records the integral over time.
    """

    sizes: Any
    densities: Any


class Sizes(NamedTuple):
    """Signals whose extremes between samples are recorded. Names and units are those of a `Row`."""

    z: Array
    e_z: Array
    sigma: Array
    u: Array
    i: Array
    e: Array
    v_tilde: Array
    z_stop: Array | tuple[()] = ()


class Densities(NamedTuple):
    """Signals that are integrated between samples: u (V), u^2 (V^2), and the copper loss in both coils (W)."""

    u: Array
    u_squared: Array
    heat: Array


NOTHING = Instant((), ())
# An Instant with the pytree structure of the recorded signals.
INSTANT_TREE = Instant(Sizes(*[0.0] * 7), Densities(*[0.0] * 3))  # pyright: ignore[reportArgumentType]


class Span(NamedTuple):
    """Signals over an interval of time.

    - `time`: length of the interval, s.
    - `most`, `least`: largest and smallest |sizes|; 0 and +inf if the interval is empty.
    - `densities`: integrals of the densities.
    """

    time: Array
    most: Any
    least: Any
    densities: Any

    def with_instant(self, instant: Instant, weight: Scalar, time: Scalar = 0.0) -> "Span":
        """Add an instant to the extremes, and to the integrals with `weight` (s). Add `time` (s) to the length."""
        sizes = jax.tree.map(jnp.abs, instant.sizes)
        most = jax.tree.map(larger, self.most, sizes)
        least = jax.tree.map(smaller, self.least, sizes)
        return Span(self.time + time, most, least, self.densities).with_densities(instant, weight)

    def with_densities(self, instant: Instant, weight: Scalar) -> "Span":
        """Add an instant to the integrals only, for a trial state that is not on the trajectory."""
        more = jax.tree.map(lambda total, x: total + weight * x, self.densities, instant.densities)
        return self._replace(densities=more)

    def shortened(self, by: Scalar) -> "Span":
        """Return the interval without its last `by` seconds, which have no derivatives. Means of densities are kept."""
        share = 1 - lax.stop_gradient(by) / jnp.where(self.time > 0, self.time, 1.0)
        return self._replace(time=share * self.time, densities=jax.tree.map(lambda x: share * x, self.densities))

    def joined(self, after: "Span") -> "Span":
        """Return the union of this interval and the next one."""
        most = jax.tree.map(larger, self.most, after.most)
        least = jax.tree.map(smaller, self.least, after.least)
        more = jax.tree.map(lambda x, y: x + y, self.densities, after.densities)
        return Span(self.time + after.time, most, least, more)


def blank(like: Instant) -> Span:
    """Return an empty interval. `like`: any Instant with the structure and the shapes of the signals."""
    zero = jnp.zeros((), jnp.result_type(float))
    nothing = jax.tree.map(lambda x: jnp.zeros(jnp.shape(x), zero.dtype), like)
    return Span(zero, nothing.sizes, jax.tree.map(lambda x: x + jnp.inf, nothing.sizes), nothing.densities)
