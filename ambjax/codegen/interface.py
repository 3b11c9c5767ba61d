"""The interfaces of the exported blocks: inputs, outputs and status bits of a step, with their units and meanings."""

from collections import namedtuple
from typing import Annotated, NamedTuple, get_type_hints

from jax import Array


def units_of(of: type) -> dict[str, tuple[str, str]]:
    """Return unit and meaning of each field of a record of inputs or outputs."""
    return {name: hint.__metadata__ for name, hint in get_type_hints(of, include_extras=True).items()}


def meanings(of: type) -> dict[str, str]:
    """Return the meaning of each field of a record of status bits, the lowest bit first."""
    return {name: hint.__metadata__[0] for name, hint in get_type_hints(of, include_extras=True).items()}


Z = Annotated[Array, "m", "rotor displacement, measured"]
ZDot = Annotated[Array, "m/s", "rotor velocity, measured"]
I = Annotated[Array, "A", "current deviation, measured"]


class StepInputs(NamedTuple):
    """Inputs of a step of the controller: the readings, and the reference.

    With prediction, the reference is that at the end of the delay, otherwise that at the instant of the readings.
    """

    z: Z
    z_dot: ZDot
    i: I
    r: Annotated[
        Array, "m", "reference of z; with prediction at the end of the delay, otherwise at the instant of the readings"
    ]
    r_dot: Annotated[Array, "m/s", "first derivative of r"]
    r_ddot: Annotated[Array, "m/s^2", "second derivative of r"]
    r_dddot: Annotated[Array, "m/s^3", "third derivative of r"]


class Status(NamedTuple):
    """Status bits of a step of the controller."""

    saturated: Annotated[Array, "u is at its limit"]
    refused: Annotated[
        Array, "a reading is NaN, beyond its limit or too far from its prediction: the prediction replaces it"
    ]
    failed: Annotated[Array, "a law returned a value that is not finite: all laws keep their states, u is held"]
    singular: Annotated[Array, "(z, i_ref) is near the singular curve of Eq. (9)"]
    safe: Annotated[
        Array, "more than guard.samples readings in a row, or all so far or since an invalid step, are refused: u is 0"
    ]
    invalid: Annotated[
        Array, "the reference, params->processor.delay or a steepness p is NaN or out of range: u is held"
    ]


class StepOutputs(NamedTuple):
    """Outputs of a step of the controller. A controller that commands a current replaces u."""

    u: Annotated[Array, "V", "voltage to apply, within the supply's limit"]
    i_ref: Annotated[Array, "A", "current reference"]
    v_star: Annotated[Array, "A^2/m^2", "demanded scaled force"]
    v_tilde: Annotated[Array, "A^2/m^2", "inversion error v_star - v(z, i_ref)"]


class PlantInputs(NamedTuple):
    """Inputs of a step of the plant: u, disturbances over one sample, and random numbers of the readings at its end."""

    u: Annotated[Array, "V", "voltage commanded at the last sample"]
    q_z: Annotated[Array, "m/s^2", "disturbance of the acceleration; a force divided by plant.m"]
    q_i: Annotated[Array, "A/s", "disturbance of the current's rate"]
    w_z: Annotated[Array, "1", "standard normal number: noise of z, divided by sensor.std"]
    w_z_dot: Annotated[Array, "1", "standard normal number: noise of z_dot, divided by sensor.std_z_dot"]
    w_i: Annotated[Array, "1", "standard normal number: noise of i, divided by sensor.std_i"]


class PlantStatus(NamedTuple):
    """Status bits of a step of the plant."""

    touched: Annotated[Array, "the rotor has reached the clearance, or with a stop 0.99 s_0: it is frozen there"]
    diverged: Annotated[Array, "a state has left the range of the model: the plant is frozen"]
    invalid: Annotated[Array, "the delay is out of range, or an input is not finite and is replaced by 0"]


class PlantOutputs(NamedTuple):
    """Outputs of a step of the plant: the readings, then the true motion and current."""

    z: Z
    z_dot: ZDot
    i: I
    z_true: Annotated[Array, "m", "rotor displacement"]
    z_dot_true: Annotated[Array, "m/s", "rotor velocity"]
    i_true: Annotated[Array, "A", "current deviation"]


INPUTS, OUTPUTS = units_of(StepInputs), units_of(StepOutputs)
DISTURBANCES, REFERENCES = PlantInputs._fields[1:], StepInputs._fields[3:]
# Inputs of a step of the loop: disturbances over the sample before it, random numbers of the sensors, the reference.
LoopInputs = namedtuple("LoopInputs", (*DISTURBANCES, *REFERENCES))
