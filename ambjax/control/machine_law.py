"""Laws of a whole machine, which demand the forces of all axes from the readings of all axes, and the linear ones.

Each axis keeps its inversion and its current law, which produce the demanded force.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.stages import ForceDemand
from ambjax.numerics.records import Scalar, matrix, record, static
from ambjax.numerics.small_matrices import times
from ambjax.numerics.smooth import limited
from ambjax.world.plant import State
from ambjax.world.rotation import PER_MINUTE
from ambjax.world.rotor import Rotor
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

L = TypeVar("L", bound="MachineLaw")


class MachineInputs(NamedTuple):
    """Inputs of a law of a machine with c axes, apart from the readings.

    - `reference`: references of the axes [c].
    - `W`: speed of the rotor, rad/s.
    - `u_max`: limits of the commands [c], V or A.
    - `start`: states of the nominal magnets of all axes for a motion and currents [c].
    - `driven`: rates of these states under commands [c] (`Cascade.driven`). Each axis has its own mass and weight.
    - `scaled`: scaled forces [c], A^2/m^2, of magnets that push with these forces [c] (N) and carry the weight.
    - `past`: commands [c] of the samples before, the most recent first; () in continuous time.
    - `period`: sample period, s; 0 in continuous time.
    """

    reference: Reference
    W: Array
    u_max: Array
    start: Callable[[Measurement], State]
    driven: Callable[[Array, State], State]
    scaled: Callable[[Array], Array]
    past: tuple[Array, ...] = ()
    period: Scalar = 0.0


class Demanded(NamedTuple):
    """Output of a law of a machine, of all axes [c].

    - `force`: demanded scaled forces of the magnets, with the motion there.
    - `estimate`: motion and currents for the current laws.
    - `now`: estimated motion at the sensors, at the sample itself, which the guard extrapolates.
    """

    force: ForceDemand
    estimate: Measurement
    now: Measurement


def demand_of(v_star: Array, measured: Measurement) -> Demanded:
    """Return the demand of scaled forces [c], A^2/m^2, at the measured places. Their rate is taken as 0."""
    force = ForceDemand(measured.z, measured.z_dot, v_star, 0.0 * v_star)
    return Demanded(force, measured, measured)


class MachineLaw(abc.ABC):
    """Base class of a law of a machine. `measured`: readings of all axes [c], in m, m/s and A.

    `output`: what the law demands of each axis, a "force", "current" or "voltage".
    """

    output: str = "force"

    def designed(self: L, rotor: Rotor) -> L:
        return self

    @abc.abstractmethod
    def begin(self, measured: Measurement, inputs: MachineInputs) -> Any:
        """Return the state at t = 0, or at the first sample: that of a rotor which rests where the sensors read."""

    def step(self, measured: Measurement, state: Any, inputs: MachineInputs) -> tuple[Demanded, Any]:
        """Step the law on a processor. Return its output and the next state; by default by explicit Euler."""
        demanded, rates = self(measured, state, inputs)
        return demanded, jax.tree.map(lambda x, rate: x + inputs.period * rate, state, rates)

    @abc.abstractmethod
    def __call__(self, measured: Measurement, state: Any, inputs: MachineInputs) -> tuple[Demanded, Any]:
        """Return the output in continuous time, and the rates of the state."""

    @abc.abstractmethod
    def scale(self) -> Any:
        """Return the characteristic size of each state."""


# Inputs of a controller with c axes: the errors r - y; r and y; or r - y and the measured currents.
ERROR, BOTH, CURRENTS = INPUTS = ("error", "both", "currents")


@record
class StateSpaceLaw(MachineLaw):
    """x+ = A x + B w + a + E (clip(u) - u), y = C x + D w + b, for the c axes: a linear controller in state space.

    In continuous time the first equation gives x'. The inputs w are r - y (m), r and y, or r - y and the currents (A),
    of the axes in order. The outputs are currents (A) or voltages (V), to which the current that carries the weight is
    added. u is the resulting command. There are matrices for s speeds, between which they are interpolated linearly.

    With inversion.Linearised, the reference of the current law of each axis is the output, or output/R for a voltage.
    """

    A: Array = matrix("s n n", "state matrices")
    B: Array = matrix("s n m", "input matrices")
    C: Array = matrix("s c n", "output matrices")
    D: Array = matrix("s c m", "matrices from inputs to outputs")
    E: Array = matrix("s n c", "anti-windup: what the limit of the command removes")
    a: Array = matrix("s n", "constant terms of the states")
    b: Array = matrix("s c", "constant terms of the outputs")
    steady: Array = matrix("n m", "states at the start per input")
    start: Array = matrix("n", "constant terms of the states at the start")
    sizes: Array = matrix("n", "characteristic sizes of the states")
    speeds: Array = matrix("s", "speeds of the designs in ascending order, rpm")
    dv_dz: Array = matrix("c", "slopes of the scaled forces of the linear magnets, A^2/m^3")
    dv_di: Array = matrix("c", "the same per current, A/m^2")
    resting: Array = matrix("c", "currents that carry the weight, A")
    resistance: Array = matrix("c", "commands per current: 1, or the resistance for outputs in V")
    inputs: str = static(default=ERROR, doc="inputs of the controller")
    output: str = static(default="current", doc="its outputs: current or voltage")

    def scale(self) -> Array:
        return jnp.asarray(self.sizes)

    def begin(self, measured: Measurement, inputs: MachineInputs) -> Array:
        return self.start + times(self.steady, self._inputs(measured, inputs))

    def step(self, measured: Measurement, state: Array, inputs: MachineInputs) -> tuple[Demanded, Array]:
        demanded, after, excess = self._output(measured, state, inputs)
        return demanded, after + times(self._at(self.E, inputs), excess)

    def __call__(self, measured: Measurement, state: Array, inputs: MachineInputs) -> tuple[Demanded, Array]:
        return self._output(measured, state, inputs)[:2]

    def _at(self, table: Array, inputs: MachineInputs) -> Array:
        """Return the entry of a table for the speed, interpolated between the designs and constant beyond them."""
        table, speeds = jnp.asarray(table), 2 * np.pi * PER_MINUTE * jnp.asarray(self.speeds)
        if len(table) == 1:
            return table[0]
        k = jnp.minimum(jnp.sum(speeds[1:] <= inputs.W), len(table) - 2)
        share = jnp.clip((inputs.W - speeds[k]) / (speeds[k + 1] - speeds[k]), 0.0, 1.0)
        return (1 - share) * table[k] + share * table[k + 1]

    def _inputs(self, measured: Measurement, inputs: MachineInputs) -> Array:
        r, y = jnp.asarray(inputs.reference.r), measured.z
        parts = {ERROR: (r - y,), BOTH: (r, y), CURRENTS: (r - y, measured.i - self.resting)}
        return jnp.concatenate(parts[self.inputs])

    def _output(self, measured: Measurement, state: Array, inputs: MachineInputs) -> tuple[Demanded, Array, Array]:
        w = self._inputs(measured, inputs)
        A, B, C, D, a, b = (self._at(x, inputs) for x in (self.A, self.B, self.C, self.D, self.a, self.b))
        i = self.resting + (times(C, state) + times(D, w) + b) / self.resistance
        u = self.resistance * i
        v_star = self.dv_dz * measured.z + self.dv_di * i
        after = times(A, state) + times(B, w) + a
        return demand_of(v_star, measured), after, limited(u, inputs.u_max) - u
