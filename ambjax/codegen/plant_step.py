"""The exported plant: motion, coils, amplifier and sensors over one sample period, in the simulator's own steps.

A step advances the plant from the last sample to the next under the voltages commanded so far, and then reads the
sensors. The first step only reads the sensors, in the initial state. The code is that of the simulator's functions
`Sampled.advance` and `Sampled.measured`. The inputs are the voltage commanded at the last sample, the disturbances,
which are constant over the sample, and the random numbers of the sensors.
"""

import dataclasses
import functools
import math
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.codegen.block import Block, Number, Ports, earlier, numbers_of, scales
from ambjax.codegen.interface import PLANT_INPUTS, PLANT_OUTPUTS, PLANT_STATUS, PlantInputs, PlantOutputs, PlantStatus
from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import Command
from ambjax.control.processor import MOST_DELAY
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar, leaf, record
from ambjax.numerics.smooth import limited
from ambjax.simulation.between import SampledState, lags, plant_status
from ambjax.simulation.integrate import Begin, FixedSteps
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.trajectory import ALIVE, DIVERGED, TOUCHED
from ambjax.world.amplifier import Amplifier, CurrentAmplifier
from ambjax.world.bearing import Bearing
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.sensor import Errors, Sensor
from ambjax.world.touchdown import Stop
from ambjax.world.waveforms import Constant

FIELDS = {field.name: field.metadata for field in dataclasses.fields(Scenario)}
COORDINATES = {
    "z": ("m", "rotor displacement"),
    "z_dot": ("m/s", "rotor velocity"),
    "i": ("A", "current deviation"),
    "i_1": ("A", "current of the upper coil"),
    "i_2": ("A", "current of the lower coil"),
    "delayed": ("A", "delayed current deviation that determines the flux, with eddy currents"),
    "delayed_1": ("A", "delayed current that determines the flux of the upper coil, with eddy currents"),
    "delayed_2": ("A", "delayed current that determines the flux of the lower coil, with eddy currents"),
}


class PlantMemory(NamedTuple):
    """State that one step passes to the next: that of a `SampledState`, without the laws.

    - `motion`: state of the plant, in its units.
    - `last`, `before`: input u of the last step and inputs of the steps before it, limited to u_max, the later one
      first, V; 0 for the first step.
    - `z_filtered`: output of the position sensor's low-pass, m; () without one.
    - `u_a`: output voltage of a slow amplifier, V; () without one.
    - `lost`: 0, or the status code with which the rotor is lost.
    - `started`: False before the first step.
    """

    motion: Any
    last: Array
    before: tuple[Array, ...]
    z_filtered: Array | tuple[()]
    u_a: Array | tuple[()]
    lost: Array
    started: Array


@record
class PlantParameters:
    """Parameters of the exported plant: true plant, sensors, amplifier, stop, initial state, limits and delay.

    Names and units are those of the case file, except that the file has actuator.u_max, run.clearance, run.stop_* and
    processor.delay for `u_max`, `clearance`, `stop.*` and `delay`. None: the case has no such part.
    """

    plant: Bearing
    sensor: Sensor | None
    actuator: Amplifier | None
    stop: Stop | None
    initial: Initial
    u_max: Scalar = dataclasses.field(metadata=FIELDS["u_max"])
    clearance: Scalar | None = dataclasses.field(metadata=FIELDS["clearance"])
    delay: Scalar = leaf(
        unit="samples", at_least=0, at_most=MOST_DELAY, doc="time from the readings until the voltage acts"
    )


@dataclasses.dataclass(frozen=True)
class PlantStep(Block):
    """The plant of a case as it is exported.

    - `cascade`: the controller, on a processor. The plant takes `whole` and `kept` from its `Processor`.
    - `method`: integrator between samples, with a fixed number of steps.
    """

    parameters: PlantParameters
    cascade: Cascade
    method: FixedSteps

    noun: ClassVar[str] = "plant"
    ports: ClassVar[Any] = PlantInputs
    inputs: ClassVar[Ports] = PLANT_INPUTS
    outputs: ClassVar[Ports] = PLANT_OUTPUTS
    bits = PLANT_STATUS
    crowded = ("touched", "diverged")

    @property
    def longest(self) -> int:
        """The longest delay that the plant can be set to, samples."""
        return len(self.cascade.timing.constant_past(jnp.zeros(())))

    def system(self, machine: PlantParameters, period: Scalar, q_z: Scalar = 0.0, q_i: Scalar = 0.0) -> Sampled:
        """Return the simulator's loop with the parameters `machine` and constant disturbances (m/s^2, A/s)."""
        cascade = self.cascade.with_processor(delay=machine.delay, assumed=None, predict=False, guard=None)
        scenario = Scenario(
            plant=machine.plant,
            q_z=Constant(q_z),
            q_i=Constant(q_i),
            sensor=machine.sensor,
            initial=machine.initial,
            u_max=machine.u_max,
            amplifier=machine.actuator,
            clearance=machine.clearance,
            stop=machine.stop,
        )
        return Sampled(ClosedLoop(cascade, scenario), period, 0)

    def step(
        self,
        parameters: PlantParameters,
        memory: PlantMemory,
        inputs: PlantInputs,
        period: Scalar,
        read: frozenset[str],
    ) -> tuple[PlantMemory, PlantOutputs, PlantStatus]:
        fine = [jnp.isfinite(getattr(inputs, name)) for name in PlantInputs._fields if name in read]
        delay = jnp.asarray(parameters.delay)
        fine += [delay >= 0, delay <= self.longest]
        u, q_z, q_i, *w = (jnp.where(jnp.isfinite(x), x, 0.0) for x in inputs)
        system = self.system(parameters, period, q_z, q_i)
        kept = choose(memory.started, self._advanced(system, memory, limited(u, parameters.u_max)), self._begun(system))
        true = parameters.plant.measurement(kept.motion)
        measured = system.measured(kept.motion, kept.z_filtered, Errors(*system.loop.scenario.sensors.scaled(w)))
        invalid = ~functools.reduce(jnp.logical_and, fine, jnp.asarray(True))
        status = PlantStatus(kept.lost == TOUCHED, kept.lost == DIVERGED, invalid)
        return kept, PlantOutputs(*measured, *true), status

    def _advanced(self, system: Sampled, memory: PlantMemory, u: Array) -> PlantMemory:
        """Return the memory at the next sample. `u`: voltage commanded at the last sample, V."""
        zero, past = jnp.zeros(()), (memory.last, *memory.before)
        state = SampledState(
            plant=memory.motion,
            control=(),
            command=Command(zero, zero, zero, zero, u),
            past=past,
            finite=jnp.ones(()),
            z_filtered=memory.z_filtered,
            u_a=memory.u_a,
        )
        code = jnp.where(memory.lost == TOUCHED, TOUCHED, jnp.where(memory.lost == ALIVE, ALIVE, DIVERGED))
        after = system.advance(self.method, Errors(zero, zero, zero), Begin(0.0, state, (), code), system.period)
        lost_now = (code == ALIVE) & (after.code != ALIVE)
        new = choose(lost_now, system.rest(after.state, after.code), after.state)
        before, lost = past[:-1], _real(after.code)
        return PlantMemory(new.plant, u, before, new.z_filtered, new.u_a, lost, jnp.asarray(True))

    def _begun(self, system: Sampled) -> PlantMemory:
        scenario, zero = system.loop.scenario, jnp.zeros(())
        motion = scenario.plant.start(scenario.initial.measurement())
        z_filtered = scenario.plant.measurement(motion).z if lags(system.loop) else ()
        lost = _real(plant_status(system.loop, motion))
        last, *before = system.processor.constant_past(zero)
        u_a = zero if scenario.actuator.slow else ()
        return PlantMemory(motion, last, tuple(before), z_filtered, u_a, lost, jnp.asarray(True))

    def start(self) -> PlantMemory:
        begun = self._begun(self.system(self.parameters, self.period))
        return jax.tree.map(jnp.zeros_like, begun)

    def numbers(self) -> list[Number]:
        found = list(numbers_of(self.parameters))
        assert [x.value for x in found] == [float(x) for x in jax.tree.leaves(self.parameters)]
        most, words = float(self.longest), "whole: rounded down" if self.cascade.timing.whole else ""
        allowed = ", ".join(filter(None, (f"from 0 to {most:g}", words)))
        delay = {"allowed": allowed, "ends": (0.0, most, most + 0.5, -0.5, math.nan), "most": most}
        return [x._replace(**delay) if x.name == "delay" else x for x in found]

    def states(self) -> list[Number]:
        memory, found = self.start(), []
        for field, value in memory.motion._asdict().items():
            count = len(jax.tree.leaves(value))  # `delayed` of a plant with eddy currents: none, one or two
            names = [field] if count == 1 else [f"{field}_{k + 1}" for k in range(count)]
            found += [Number(name, *COORDINATES[name]) for name in names]
        found.append(Number("last.u", "V", "voltage of the sample before the last"))
        found += earlier(memory.before, "V", "voltage")
        if not isinstance(memory.z_filtered, tuple):
            found.append(Number("z_filtered", "m", "output of the position sensor's low-pass"))
        if not isinstance(memory.u_a, tuple):
            found.append(Number("u_a", "V", "output voltage of the amplifier"))
        codes = f"0, {TOUCHED} after touch-down, {DIVERGED} after divergence"
        lost = Number("lost", "", codes, among=(*[float(ALIVE)] * 8, float(TOUCHED), float(DIVERGED)))
        return [*found, lost]

    def sizes(self) -> tuple[list[float], list[float]]:
        plant, memory = self.parameters.plant, self.start()
        z, _, i = scales(plant.sizes())
        weight, pole = float(plant.R) * float(plant.i_0), float(plant.pole)
        u = float(self.parameters.u_max) if math.isfinite(self.parameters.u_max) else 10 * weight + 1.0
        extra = [
            *([] if isinstance(memory.z_filtered, tuple) else [z]),
            *([] if isinstance(memory.u_a, tuple) else [u]),
        ]
        return [*scales(plant.scale()), *[u] * self.longest, *extra, 1.0], [u, z * pole**2, i * pole, 1.0, 1.0, 1.0]

    def described(self) -> list[str]:
        parts = self.parameters
        sensor = "sensors: exact" if parts.sensor is None else f"sensors: {_given(parts.sensor)}"
        amplifier = "amplifier: ideal" if parts.actuator is None else f"amplifier: {_given(parts.actuator)}"
        return [f"plant: {type(parts.plant).__name__}, {self.method} per period", sensor, amplifier]


def _given(part: Any) -> str:
    """Return the names of all parameters of a part, separated by commas, without those that are None."""
    return ", ".join(x.name for x in numbers_of(part))


def _real(code: Array) -> Array:
    """Return a status code as a real number, the type of a state of exported code."""
    one = jnp.ones(())
    return jnp.where(code == ALIVE, 0 * one, jnp.where(code == TOUCHED, TOUCHED * one, DIVERGED * one))


def plant_of(cascade: Cascade, scenario: Scenario, period: float, method: FixedSteps) -> PlantStep:
    """Return the plant of a case as it is exported. `period`: sample period, s. `method`: integrator between samples.

    `cascade`: on a processor. Raises ValueError for an amplifier that controls the current, and for faults or a runout
    of the sensor.
    """
    if isinstance(scenario.amplifier, CurrentAmplifier):
        raise ValueError(
            'actuator.mode = "current": the exported plant takes a voltage. Export the controller, or use '
            'mode = "voltage".'
        )
    for part in ("outliers", "dropouts", "runout"):
        if getattr(scenario.sensors, part) is not None:
            raise ValueError(
                f"sensor.{part}: the exported plant does not model this error. Remove it, and add it to the output z."
            )
    resolved = cascade.on_processor()
    parts = scenario.plant, scenario.sensor, scenario.amplifier, scenario.stop, scenario.initial
    machine = PlantParameters(*parts, scenario.u_max, scenario.clearance, resolved.timing.delay)
    plain = jax.tree.map(lambda x: float(x) if jnp.shape(x) == () else x, machine)
    return PlantStep(plain, float(period), resolved, method)
