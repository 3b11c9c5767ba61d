"""The interfaces of the exported blocks: inputs, outputs and status bits of a step, with their units and meanings.

A port has a unit and a meaning, a status bit a meaning; the lowest bit is the first.
"""

from collections import namedtuple

READINGS = {
    "z": ("m", "rotor displacement, measured"),
    "z_dot": ("m/s", "rotor velocity, measured"),
    "i": ("A", "current deviation, measured"),
}
REFERENCES = {
    "r": ("m", "reference of z; with prediction at the end of the delay, otherwise at the instant of the readings"),
    "r_dot": ("m/s", "first derivative of r"),
    "r_ddot": ("m/s^2", "second derivative of r"),
    "r_dddot": ("m/s^3", "third derivative of r"),
}
# The controller. If it commands a current, it replaces u.
INPUTS = READINGS | REFERENCES
OUTPUTS = {
    "u": ("V", "voltage to apply, within the supply's limit"),
    "i_ref": ("A", "current reference"),
    "v_star": ("A^2/m^2", "demanded scaled force"),
    "v_tilde": ("A^2/m^2", "inversion error v_star - v(z, i_ref)"),
}
STATUS = {
    "saturated": "u is at its limit",
    "refused": "a reading is NaN, beyond its limit or too far from its prediction: the prediction replaces it",
    "failed": "a law returned a value that is not finite: all laws keep their states, u is held",
    "singular": "(z, i_ref) is near the singular curve of Eq. (9)",
    "safe": "more than guard.samples readings in a row, or all so far or since an invalid step, are refused: u is 0",
    "invalid": "the reference, params->processor.delay or a steepness p is NaN or out of range: u is held",
}
# Disturbances over one sample, and random numbers of the readings at its end.
DISTURBANCES = {
    "q_z": ("m/s^2", "disturbance of the acceleration; a force divided by plant.m"),
    "q_i": ("A/s", "disturbance of the current's rate"),
    "w_z": ("1", "standard normal number: noise of z, divided by sensor.std"),
    "w_z_dot": ("1", "standard normal number: noise of z_dot, divided by sensor.std_z_dot"),
    "w_i": ("1", "standard normal number: noise of i, divided by sensor.std_i"),
}
PLANT_INPUTS = {"u": ("V", "voltage commanded at the last sample")} | DISTURBANCES
PLANT_OUTPUTS = READINGS | {
    "z_true": ("m", "rotor displacement"),
    "z_dot_true": ("m/s", "rotor velocity"),
    "i_true": ("A", "current deviation"),
}
PLANT_STATUS = {
    "touched": "the rotor has reached the clearance, or with a stop 0.99 s_0: it is frozen there",
    "diverged": "a state has left the range of the model: the plant is frozen",
    "invalid": "the delay is out of range, or an input is not finite and is replaced by 0",
}
StepInputs, StepOutputs = namedtuple("StepInputs", INPUTS), namedtuple("StepOutputs", OUTPUTS)
PlantInputs, PlantOutputs = namedtuple("PlantInputs", PLANT_INPUTS), namedtuple("PlantOutputs", PLANT_OUTPUTS)
LoopInputs = namedtuple("LoopInputs", DISTURBANCES | REFERENCES)
Status, PlantStatus = namedtuple("Status", STATUS), namedtuple("PlantStatus", PLANT_STATUS)
