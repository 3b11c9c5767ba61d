"""The ports of an exported plant: inputs, outputs, status bits and states, with their units and meanings."""

from typing import NamedTuple

from jax import Array


class PlantInputs(NamedTuple):
    """Inputs of a step of the plant: u, disturbances over one sample, and random numbers of the readings at its end."""

    u: Array
    q_z: Array
    q_i: Array
    w_z: Array
    w_z_dot: Array
    w_i: Array


class PlantStatus(NamedTuple):
    """Status of a step of the plant, one bit each."""

    touched: Array
    diverged: Array
    invalid: Array


class PlantOutputs(NamedTuple):
    """Outputs of a step of the plant: the readings, then the true motion and current."""

    z: Array
    z_dot: Array
    i: Array
    z_true: Array
    z_dot_true: Array
    i_true: Array


DISTURBANCES = {
    "q_z": ("m/s^2", "disturbance of the acceleration; a force divided by plant.m"),
    "q_i": ("A/s", "disturbance of the current's rate"),
    "w_z": ("1", "standard normal number: noise of z, divided by sensor.std"),
    "w_z_dot": ("1", "standard normal number: noise of z_dot, divided by sensor.std_z_dot"),
    "w_i": ("1", "standard normal number: noise of i, divided by sensor.std_i"),
}
READINGS = {
    "z": ("m", "rotor displacement, measured"),
    "z_dot": ("m/s", "rotor velocity, measured"),
    "i": ("A", "current deviation, measured"),
    "z_true": ("m", "rotor displacement"),
    "z_dot_true": ("m/s", "rotor velocity"),
    "i_true": ("A", "current deviation"),
}
LOSSES = {
    "touched": "the rotor has reached the clearance, or with a stop 0.99 s_0: it is frozen there",
    "diverged": "a state has left the range of the model: the plant is frozen",
}
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
