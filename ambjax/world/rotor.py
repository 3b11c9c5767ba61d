"""The rotor of a machine with several magnetic bearing axes: rigid, or with bending modes."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, bounded, leaf, matrix, part, record, static
from ambjax.numerics.small_matrices import times
from ambjax.numerics.smooth import TWO_PI, sine
from ambjax.world.rotation import GRAM_MM, PER_MINUTE, Rotation, SpeedChange
from ambjax.world.scenario import SIGNAL_STREAM, SLOTS
from ambjax.world.waveforms import Signal, edges_of, realised


@record
class RotorUnbalance:
    """An unbalance at a place of the shaft. It turns with the rotor."""

    amount: Scalar = leaf(unit="g mm", at_least=0, at_most=1e9, doc="unbalance mass times its distance from the axis")
    along_x: Array = matrix("n", "forces on the coordinates per force along x at the place", unit="1")
    along_y: Array = matrix("n", "the same for y", unit="1")
    phase: Scalar = bounded(0.0, "degrees", -1e6, 1e6, "angle from the x axis at rotor angle 0")
    graded: bool = static(default=False, doc="whether the amount is that of a balance quality grade, per mass")

    def force(self, turns: Array, W: Array, W_dot: Array) -> Array:
        """Return the forces [n] on the coordinates. `turns`: rotor angle. `W`, `W_dot`: speed (rad/s) and its rate."""
        angle = turns + self.phase / 360
        sin, cos = sine(angle), sine(angle + 0.25)
        x, y = W * W * cos + W_dot * sin, W * W * sin - W_dot * cos
        return GRAM_MM * self.amount * (self.along_x * x + self.along_y * y)


@record
class RotorLoad:
    """A load on the rotor, in N, at a place and in a direction."""

    signal: Signal = part(doc="the load over time, N")
    along: Array = matrix("n", "forces on the coordinates per unit of the load", unit="1")


@record
class BaseMotion:
    """A motion of the stator along a direction. q is relative to the stator, so that -M `along` times it acts on q."""

    signal: Signal = part(doc="the acceleration of the stator over time, m/s^2")
    along: Array = matrix("n", "unit vector of the direction as x, y, z; 0 for the other coordinates", unit="1")


@record
class Rotor:
    """A rotor with n coordinates q and c bearing axes: M q'' + (D + W G) q' + K q = sum of b_k F_k + other forces.

    W is the speed in rad/s. The first five coordinates are x, y, z (m) of the centre of mass and the tilts beta_x,
    beta_y (rad), in the frame of the stator; z is along the shaft. Each bending mode adds two coordinates, one in x and
    one in y. A point of the shaft at l (m from the centre of mass) moves by (x + l beta_y, y - l beta_x, z).
    """

    M: Array = matrix("n n", "mass matrix")
    D: Array = matrix("n n", "damping matrix")
    G: Array = matrix("n n", "gyroscopic matrix")
    K: Array = matrix("n n", "stiffness matrix")
    at_magnets: Array = matrix("c n", "rows b_k: z_k = b_k q is the displacement at the magnet of axis k")
    at_sensors: Array = matrix("c n", "rows c_k: c_k q is what the sensor of axis k sees")
    gravity: Array = matrix("n", "weight, as forces on the coordinates")
    speed: Scalar = bounded(0.0, "rpm", -1e7, 1e7, "speed at t = 0")
    acceleration: Scalar = bounded(0.0, "rpm/s", -1e9, 1e9, "rate of the speed")
    changes: tuple[SpeedChange, ...] = part(default=(), doc="later changes of the rate, of a table of speeds")
    unbalances: tuple[RotorUnbalance, ...] = part(default=(), doc="unbalances")
    loads: tuple[RotorLoad, ...] = part(default=(), doc="loads")
    base: tuple[BaseMotion, ...] = part(default=(), doc="motions of the stator")
    at_stops: Array | None = matrix(
        "c n", "rows of the displacement at the stop of axis k; None: the stops are at the magnets", default=None
    )

    @property
    def rotation(self) -> Rotation:
        return Rotation(self.speed, self.acceleration, changes=self.changes)

    def speed_at(self, t: Scalar) -> Array:
        """Return the speed W at time t (s), rad/s."""
        return self.rotation.omega(t)

    def forces(self, t: Scalar) -> Array:
        """Return weight, unbalance forces, loads and inertia of the base motion at t (s), on the coordinates [n]."""
        turns, W = self.rotation.turns(t), self.speed_at(t)
        rate = self.acceleration + sum(jnp.where(t >= one.at, one.by, 0.0) for one in self.changes)
        W_dot = jnp.asarray(TWO_PI * PER_MINUTE * rate)
        total = jnp.asarray(self.gravity)
        for one in self.unbalances:
            total = total + one.force(turns, W, W_dot)
        for load in self.loads:
            total = total + load.along * load.signal(t)
        for motion in self.base:
            total = total - times(self.M, motion.along) * motion.signal(t)
        return total

    def without_forces(self) -> "Rotor":
        """Return the rotor with its weight, without unbalances, loads and base motion."""
        return dataclasses.replace(self, unbalances=(), loads=(), base=())

    def edges(self) -> tuple[Scalar, ...]:
        signals = [one.signal for one in (*self.loads, *self.base)]
        return (*self.rotation.edges(), *(edge for signal in signals for edge in edges_of(signal)))

    def realised(self, key: Array) -> "Rotor":
        """Return the rotor with its random loads and base motions drawn. `key`: random key of the member."""
        key = jax.random.fold_in(key, SIGNAL_STREAM)
        drawn = [
            dataclasses.replace(load, signal=realised(load.signal, jax.random.fold_in(key, len(SLOTS) + n)))
            for n, load in enumerate((*self.loads, *self.base))
        ]
        loads = len(self.loads)
        return dataclasses.replace(self, loads=tuple(drawn[:loads]), base=tuple(drawn[loads:]))
