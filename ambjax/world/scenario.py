"""The scenario: true plant, initial state, reference, disturbances, sensors and amplifier."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, bounded, part, record
from ambjax.world.amplifier import Amplifier, CoilVoltages, CurrentAmplifier
from ambjax.world.bearing import Bearing
from ambjax.world.plant import Plant
from ambjax.world.recorded import Knots
from ambjax.world.rotation import Rotation, turned
from ambjax.world.sensor import IdealSensor, Measurement, Sensor
from ambjax.world.touchdown import Stop
from ambjax.world.waveforms import Constant, Signal, edges_of, frequencies_of, is_random, knots_of, realised

# Numbers that are folded into a member's key, for the random streams of the design and of the signals. The sensors use
# other streams of this key (`numerics.gaussian.STREAMS`, `faults`), with the sample number as counter.
DESIGN_STREAM, SIGNAL_STREAM = np.uint32(2**32 - 1), np.uint32(2**32 - 2)
# Fields that are signals. The position in this list selects the random key of a signal, so add new fields at the end.
SLOTS = ("reference", "q_z", "q_v", "q_i", "q_f", "base")
# |z| at which a rotor with an elastic stop is lost, as a share of s_0. The lower bound of the gaps (GAP_FLOOR) acts
# only at a larger |z|.
POLE = 0.99
# An amplifier without any of its fields applies the command at once, and without a limit of its own.
_IDEAL_SENSOR, _IDEAL_AMPLIFIER = IdealSensor(), Amplifier()


@record
class Initial:
    """State of the plant at t = 0."""

    z: Scalar = bounded(0.0, "m", -1.0, 1.0, "displacement, within the clearance")
    z_dot: Scalar = bounded(0.0, "m/s", -1e6, 1e6, "velocity")
    i: Scalar = bounded(0.0, "A", -1e6, 1e6, "current deviation")

    def measurement(self) -> Measurement:
        return Measurement(*(jnp.asarray(x) for x in (self.z, self.z_dot, self.i)))


@record
class Scenario:
    """All inputs of a rollout except the controller and the clock. Member k of seed s always draws the same noise."""

    plant: Bearing = part(default=Plant(), doc="the true plant")
    reference: Signal = part(default=Constant(), doc="position that the rotor must follow, m")
    q_z: Signal = part(default=Constant(), doc="disturbance acceleration, m/s^2")
    q_v: Signal = part(
        default=Constant(), doc="disturbance as scaled force, A^2/m^2: adds a q_v to q_z, with the a of the true plant"
    )
    q_i: Signal = part(default=Constant(), doc="disturbance of the current's rate, A/s")
    q_f: Signal | None = part(
        default=None, doc="disturbance as force, N: adds q_f / m to q_z, with the m of the true plant; None: no force"
    )
    base: Signal | None = part(
        default=None,
        doc="acceleration of the housing, m/s^2: adds -base to q_z, because z is relative to the housing; None: 0",
    )
    rotor: Rotation | None = part(
        default=None, doc="speed of the rotor, which unbalance and runout follow; None: not turning"
    )
    sensor: Sensor | None = part(default=None, doc="errors of the sensors; None: no errors")
    initial: Initial = part(default=Initial(), doc="state of the plant at t = 0")
    u_max: Scalar = bounded(jnp.inf, "V", 1e-9, 1e12, "limit of the supply; inf: no limit", infinite=True)
    amplifier: Amplifier | CurrentAmplifier | None = part(
        default=None, doc="amplifier; None: the coils receive the commanded voltage"
    )
    clearance: Scalar | None = bounded(None, "m", 1e-9, 1.0, "|z| at which the rotor touches down; none: 0.9 s_0")
    stop: Stop | None = part(
        default=None, doc="the touchdown bearing at the clearance; None: a rotor that reaches the clearance is lost"
    )
    seed: Scalar = bounded(0, "", 0, 2**32 - 1, "seed of the noise", whole=True)
    member: Scalar = bounded(0, "", 0, 2**32 - 1, "member of an ensemble", whole=True)

    @property
    def touchdown(self) -> Scalar:
        """|z| at which the rotor touches down, m."""
        return 0.9 * self.plant.s_0 if self.clearance is None else self.clearance

    @property
    def limit(self) -> Scalar:
        """|z| at which the rotor is lost, m: `touchdown`, or POLE s_0 with an elastic stop."""
        return self.touchdown if self.stop is None else POLE * self.plant.s_0

    @property
    def sensors(self) -> Sensor:
        return self.sensor or _IDEAL_SENSOR

    @property
    def actuator(self) -> Amplifier | CurrentAmplifier:
        return self.amplifier or _IDEAL_AMPLIFIER

    @property
    def drive(self) -> str:
        """What the controller commands: "voltage" or "current"."""
        return self.actuator.mode

    @property
    def command_limit(self) -> Scalar:
        """Limit of the command: of the voltage (V) or of the current (A)."""
        return self.actuator.command_limit(self.u_max)

    def coil_voltage(self, command: Array, state: Any, q_i: Scalar = 0.0) -> Array:
        """Return the voltage at the coils, V.

        `command`: output voltage of the amplifier's lag (V), or the commanded current (A). `state`: of the plant.
        `q_i`: disturbance of the current's rate, A/s.
        """
        plant = self.plant

        def response() -> tuple[Array, Array]:
            still, driven = (plant.measurement(plant.rates(state, volt, 0.0, q_i)).i for volt in (0.0, 1.0))
            return still, driven - still  # i' is linear in u

        return self.actuator.at_coil(command, plant.measurement(state).i, self.u_max, response)

    def applied(self, u: Array, state: Any, q_i: Scalar = 0.0) -> Array | CoilVoltages:
        """Return the result of `coil_voltage` or, if each coil has limits, the limited voltages of both coils."""
        u, coil = self.coil_voltage(u, state, q_i), self.actuator.coil
        return u if coil is None else coil.applied(self.plant, state, u, q_i)

    @property
    def voltage_limit(self) -> Scalar:
        """The |u| (V) at which the supply or the voltage of a coil is at its limit."""
        coil = self.actuator.coil
        return self.u_max if coil is None else jnp.minimum(self.u_max, coil.reserve(self.plant.R * self.plant.i_0))

    @property
    @jax.jit  # compiles one program instead of one for each operation
    def largest_force(self) -> Scalar:
        """The largest lasting magnetic force (N) at z = 0: for i = i_0, or the limit of |i| if it is below i_0.

        The voltage limits |i| at rest, too: R |i| is at most the limit of the supply or of a coil, less the dead band.
        """
        i_max, R = self.actuator.current_limit(self.plant.i_0), jnp.asarray(self.plant.R)
        dead = getattr(self.actuator, "dead_band", None)
        most = self.voltage_limit - (0.0 if dead is None else dead)
        limits = (R > 0) & (most > 0)  # the reader warns of an amplifier that gives nothing
        driven = jnp.where(limits, most / jnp.where(limits, R, 1.0), jnp.inf)
        return self.plant.largest_force(driven if i_max is None else jnp.minimum(i_max, driven))

    @property
    def current_slope(self) -> Scalar:
        """The fastest rate of the current, 1/s: R/L of a coil, or that of the amplifier's current loop if greater."""
        coils = self.plant.coil_slope(self.limit)
        return coils if self.drive == "voltage" else jnp.maximum(jnp.asarray(coils), self.actuator.slope())

    def load_rate(self) -> float:
        """Return the largest angular frequency of the loads of all members, 1/s; 0 where it is traced."""
        loads = [getattr(self, slot) for slot in SLOTS[1:]]
        return 2 * np.pi * max((high for _, high in frequencies_of(tuple(loads))), default=0.0)

    def pushed(self, q_z: Array, motion: Measurement) -> Array:
        """Return the disturbance q_z (m/s^2) plus the acceleration by the stop, for the true motion of the rotor."""
        return q_z if self.stop is None else q_z + self.stop.force(motion, self.touchdown) / self.plant.m

    @property
    def random(self) -> bool:
        """Whether the scenario has sensor noise, random sensor faults or a random signal. A spread does not count."""
        sensor = self.sensors
        rates = [x.rate for x in (sensor.outliers, sensor.dropouts) if x is not None]
        return any(map(np.any, (*sensor.noises, *rates))) or any(is_random(getattr(self, slot)) for slot in SLOTS)

    @property
    def on_processor(self) -> str | None:
        """The dotted path of a part that requires a processor; None if there is none."""
        if isinstance(self.amplifier, Amplifier):
            given = (field.name for field in dataclasses.fields(self.amplifier))
            return f"actuator.{next((name for name in given if getattr(self.amplifier, name) is not None), '')}"
        named = [name for name in Sensor.sampled if getattr(self.sensors, name) is not None]
        return f"sensor.{named[0]}" if named else None

    def in_continuous_time(self) -> "Scenario":
        """Return the scenario without the parts that require a processor.

        They are the low-pass, the converter and the faults of the sensor, and an amplifier that applies a voltage.
        """
        amplifier = self.amplifier if self.drive == "current" else None
        return dataclasses.replace(self.with_sensor(**dict.fromkeys(Sensor.sampled)), amplifier=amplifier)

    def with_sensor(self, **fields: object) -> "Scenario":
        """Return the scenario with other fields of its sensor. Ideal sensors do not change."""
        return dataclasses.replace(self, sensor=self.sensor and dataclasses.replace(self.sensor, **fields))

    def louder(self, factor: Scalar) -> "Scenario":
        return dataclasses.replace(self, sensor=self.sensor and self.sensor.louder(factor))

    def displaced(self, share: Scalar) -> "Scenario":
        """Return the scenario with its start displaced by this share of the clearance, towards z = 0."""
        z = jnp.asarray(self.initial.z)
        z = z + jnp.where(z > 0, -1.0, 1.0) * share * jnp.asarray(self.touchdown)
        return dataclasses.replace(self, initial=dataclasses.replace(self.initial, z=z))

    def acceleration(self, t: Scalar) -> Array:
        """Return the total disturbance of Eq. (1) at time t: q_z + a q_v + q_f / m - base, m/s^2."""
        total = self.q_z(t) + self.plant.a * self.q_v(t)
        if self.q_f is not None:
            total = total + self.q_f(t) / self.plant.m
        return total if self.base is None else total - self.base(t)

    def edges(self, reference: bool = False) -> tuple[Scalar, ...]:
        """Return the edges (s) of the disturbances; with `reference`, also those of the reference."""
        return tuple(edge for signal in self._signals(reference) for edge in edges_of(signal))

    def knots(self, reference: bool = False) -> tuple[Knots, ...]:
        """Return the knots of recorded disturbances; with `reference`, also those of the reference."""
        return tuple(one for signal in self._signals(reference) for one in knots_of(signal))

    def _signals(self, reference: bool) -> tuple[Signal | None, ...]:
        turning = self.turning()
        return tuple(getattr(turning, slot) for slot in SLOTS if reference or slot != "reference")

    def turning(self) -> "Scenario":
        """Return the scenario in which unbalances and runout have the speed of the rotor."""
        if self.rotor is None:
            return self
        signals = {slot: turned(getattr(self, slot), self.rotor) for slot in SLOTS}
        sensor = self.sensor and dataclasses.replace(self.sensor, runout=turned(self.sensor.runout, self.rotor))
        return dataclasses.replace(self, sensor=sensor, **signals)

    def undisturbed(self) -> "Scenario":
        none = Constant()
        calm = dataclasses.replace(self, q_z=none, q_v=none, q_i=none, q_f=None, base=None)
        return calm.with_sensor(runout=None)

    def key(self) -> Array:
        """The member's random key: fold_in(key(seed), member)."""
        return jax.random.fold_in(jax.random.key(self.seed), self.member)

    def words(self) -> tuple[Array, Array]:
        """The member's random key (`key`) as two 32-bit words."""
        high, low = jax.random.key_data(self.key())
        return high, low

    def realised(self) -> "Scenario":
        """Return the scenario of the member: `turning`, with its random signals drawn."""
        turning = self.turning()
        random = {slot: signal for slot in SLOTS if hasattr(signal := getattr(turning, slot), "realised")}
        if not random:
            return turning
        key = jax.random.fold_in(self.key(), SIGNAL_STREAM)
        draws = {slot: realised(signal, jax.random.fold_in(key, SLOTS.index(slot))) for slot, signal in random.items()}
        return dataclasses.replace(turning, **draws)
