"""Laws of a whole machine: they demand the forces of all axes from the readings of all axes.

Each axis keeps its inversion and its current law, which produce the demanded force.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
from jax import Array

from ambjax.control.stages import ForceDemand
from ambjax.numerics.records import Scalar
from ambjax.world.plant import State
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
        """Return the law for a nominal rotor; by default the law itself."""
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
