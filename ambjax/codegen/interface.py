"""The interface of a step: its inputs, outputs and status bits, with their units and meanings."""

from typing import NamedTuple

from jax import Array


class StepInputs(NamedTuple):
    """Inputs of a step: the readings, and the reference.

    With prediction, the reference is that at the end of the delay, otherwise that at the instant of the readings.
    """

    z: Array
    z_dot: Array
    i: Array
    r: Array
    r_dot: Array
    r_ddot: Array
    r_dddot: Array


class Status(NamedTuple):
    """Status of a step, one bit each; BITS has their meanings."""

    saturated: Array
    refused: Array
    failed: Array
    singular: Array
    safe: Array
    invalid: Array


class StepOutputs(NamedTuple):
    """Outputs of a step; OUTPUTS has their units and meanings."""

    u: Array
    i_ref: Array
    v_star: Array
    v_tilde: Array


INPUTS = {
    "z": ("m", "rotor displacement, measured"),
    "z_dot": ("m/s", "rotor velocity, measured"),
    "i": ("A", "current deviation, measured"),
    "r": ("m", "reference of z; with prediction at the end of the delay, otherwise at the instant of the readings"),
    "r_dot": ("m/s", "first derivative of r"),
    "r_ddot": ("m/s^2", "second derivative of r"),
    "r_dddot": ("m/s^3", "third derivative of r"),
}


# The output u, by the quantity that the controller commands (`CurrentLaw.commands`).
COMMANDS = {
    "voltage": ("V", "voltage to apply, within the supply's limit"),
    "current": ("A", "current to command to the amplifier, within its limit"),
}
OUTPUTS = {
    "u": COMMANDS["voltage"],
    "i_ref": ("A", "current reference"),
    "v_star": ("A^2/m^2", "demanded scaled force"),
    "v_tilde": ("A^2/m^2", "inversion error v_star - v(z, i_ref)"),
}


def outputs_of(commands: str) -> dict[str, tuple[str, str]]:
    """Return unit and meaning of each output of a controller that commands a "voltage" or a "current"."""
    return OUTPUTS | {"u": COMMANDS[commands]}


BITS = {
    "saturated": "u is at its limit",
    "refused": "a reading is NaN, beyond its limit or too far from its prediction: the prediction replaces it",
    "failed": "a law returned a value that is not finite: all laws keep their states, u is held",
    "singular": "(z, i_ref) is near the singular curve of Eq. (9)",
    "safe": "more than guard.samples readings in a row, or all so far or since an invalid step, are refused: u is 0",
    "invalid": "the reference, params->processor.delay or a steepness p is NaN or out of range: u is held",
}
