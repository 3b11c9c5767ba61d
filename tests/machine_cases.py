"""Eight machines as case dictionaries, all held: what `machine_oracle` and another program are compared on."""

import numpy as np

RIG = {"mu_0": 1.2566e-6, "n": 208.0, "A": 2.68e-4, "s_0": 5e-4, "i_0": 2.5, "R": 1.0}
PID = {"position": {"kind": "pid"}, "inversion": {"kind": "linearised"}, "current": {"kind": "pi"}}
CLOCK = {"duration": 0.02, "sample_period": 5e-5}
SHORT = {"kind": "rigid", "m": 3.273, "I_t": 0.12542, "I_p": 3.643e-3}
SPIN = SHORT["I_p"] / SHORT["I_t"]
LEFT = {"name": "left", "kind": "radial", "at": -0.2516}
RIGHT = {"name": "right", "kind": "radial", "at": 0.2584}
THRUST = {"name": "thrust", "kind": "axial", "at": 0.1}


def processor(**keys):
    return {"guard": False, **keys}


MACHINES = {
    # the paper's cascade on four axes, default gains, a delay of one sample with prediction; off centre and tilted
    "rigid": {
        "plant": RIG, "rotor": SHORT, "bearing": [LEFT, RIGHT], "processor": processor(delay=1.0), "clock": CLOCK,
        "initial": {"q": [3e-5, -4e-5, 0.0, 1e-4, -5e-5]},
    },
    # a disc: I_p above I_t, 12,000 rpm; PID, linearised inversion, PI; no prediction; sensors apart; a limited supply;
    # own gains and an own magnet on the right; currents that do not begin at 0
    "gyroscopic": {
        "plant": RIG,
        "rotor": {"kind": "rigid", "m": 4.0, "I_t": 0.03, "I_p": 0.045, "speed": 12000.0},
        "bearing": [
            LEFT | {"at": -0.12, "sensor_at": -0.135},
            RIGHT | {
                "at": 0.15, "sensor_at": 0.16, "plant": {"A": 3.2e-4, "s_0": 6e-4},
                "controller": {"position": {"k_d": 2000.0, "k_int": 1e7}},
            },
        ],
        "controller": PID,
        "processor": processor(delay=1.0, predict=False),
        "actuator": {"u_max": 30.0},
        "initial": {"q": [2e-5, 1e-5, 0.0, 1e-4, 2e-4], "i": [0.1, 0.2, 0.0, 0.3]},
        "clock": CLOCK,
    },
    # two coils an axis at 45 degrees: the weight is on all axes; a delay of 1.5 samples; a step and a sine of force
    "slanted": {
        "plant": RIG | {"kind": "two-coil"},
        "rotor": SHORT | {"speed": 3000.0},
        "bearing": [LEFT | {"angle": 45.0}, RIGHT | {"angle": 45.0}],
        "controller": {"inversion": {"kind": "closed-form"}},
        "processor": processor(delay=1.5),
        "actuator": {"u_max": 60.0},
        "load": [
            {"at": 0.1, "direction": [0.6, 0.8, 0.0], "kind": "step", "amplitude": 10.0, "start": 0.005},
            {"at": -0.2, "direction": [1.0, 0.0, 0.0], "kind": "sine", "amplitude": 3.0, "frequency": 150.0},
        ],
        "clock": CLOCK,
    },
    # five axes; no velocity is measured: Kalman observers; a leaning shaft; a sensor apart;
    # the thrust axis with its own magnet and PID
    "five": {
        "plant": RIG,
        "rotor": SHORT | {"speed": 6000.0, "gravity": [1.0, -9.0, -3.8]},
        "bearing": [
            LEFT | {"angle": 30.0, "sensor_at": -0.24},
            RIGHT,
            THRUST | {"plant": {"A": 4e-4, "i_0": 2.0}, "controller": PID | {"observer": {"kind": "kalman"}}},
        ],
        "controller": {"observer": {"kind": "kalman"}},
        "sensor": {"velocity": False},
        "processor": processor(delay=1.0),
        "initial": {"q": [1e-5, -2e-5, 3e-5, 5e-5, 0.0]},
        "clock": CLOCK,
    },
    # from 600 to 6,600 rpm in 20 ms with two unbalances; set-valued signs; a delay of half a sample
    "run-up": {
        "plant": RIG,
        "rotor": SHORT | {"speed": 600.0, "acceleration": 3e5},
        "bearing": [LEFT, RIGHT],
        "controller": {
            "position": {"c": 600.0, "k": 40.0, "p": float("inf")},
            "inversion": {"gamma": 5e11, "p": float("inf")},
            "current": {"k_i": 3000.0, "p": float("inf")},
        },
        "processor": processor(delay=0.5),
        "unbalance": [{"at": 0.1, "amount": 60.0, "phase": 30.0}, {"at": -0.2, "amount": 40.0, "phase": -100.0}],
        "clock": CLOCK,
    },
    # two bending modes with gyroscopic terms, also with the tilt; sensors 15 mm outside the magnets; an unbalance and
    # a pulse of force that act on the modes; the base shakes, at a slant and with a pulse
    "bending": {
        "plant": RIG,
        "rotor": SHORT | {
            "kind": "modal", "speed": 4000.0,
            "modes": [{"frequency": 105.0, "damping": 0.005}, {"frequency": 420.0, "damping": 0.005}],
            "Gm": [[0.0] * 4, [0.0, SPIN, 0.2, 0.1], [0.0, 0.2, 0.3, -0.1], [0.0, 0.1, -0.1, 0.2]],
        },
        "bearing": [
            LEFT | {"sensor_at": -0.2666, "modes": [-0.45, 0.25], "sensor_modes": [-0.55, 0.4]},
            RIGHT | {"sensor_at": 0.2734, "modes": [-0.46, -0.24], "sensor_modes": [-0.56, -0.39]},
        ],
        "controller": PID,
        "processor": processor(delay=1.0),
        "unbalance": [{"at": 0.0, "amount": 30.0, "phase": 0.0, "modes": [0.62, 0.01]}],
        "load": [
            {
                "at": 0.0, "direction": [0.0, 1.0, 0.0], "modes": [0.62, 0.01],
                "kind": "pulse", "amplitude": 20.0, "start": 0.002, "stop": 0.00303,
            }
        ],
        "base": [
            {"direction": [3.0, -4.0, 0.0], "kind": "sine", "amplitude": 2.0, "frequency": 80.0},
            {"direction": [0.0, 1.0, 0.5], "kind": "pulse", "amplitude": 3.0, "start": 0.00601, "stop": 0.009},
        ],
        "initial": {"q": [1e-5, 1e-5, 0.0, 2e-5, 2e-5]},
        "clock": CLOCK,
    },
    # one axis across the shaft, with a bending mode; the sensor apart
    "one": {
        "plant": RIG, "processor": processor(delay=1.0), "clock": CLOCK, "initial": {"q": [0.0, 3e-5, 0.0, 0.0, 0.0]},
        "rotor": SHORT | {"kind": "modal", "m": 1.64, "modes": [{"frequency": 900.0, "damping": 0.01}]},
        "bearing": [{"name": "mid", "kind": "radial", "at": 0.0, "axes": ["y"], "modes": [0.4], "sensor_modes": [0.3]}],
    },
    # rigid-body coordinates: PID on translation, tilt and axial motion, with other gains for each; Kalman observers;
    # a disc at 9,000 rpm, of which the gyroscopic terms are compensated; three kinds of magnets; one axis at an angle
    "coordinates": {
        "plant": RIG,
        "rotor": {"kind": "rigid", "m": 4.0, "I_t": 0.05, "I_p": 0.07, "speed": 9000.0, "gravity": [1.0, -9.0, -3.8]},
        "bearing": [
            LEFT | {"at": -0.12, "sensor_at": -0.135, "angle": 30.0},
            RIGHT | {"at": 0.15, "plant": {"A": 3.2e-4, "s_0": 6e-4}},
            THRUST | {"plant": {"A": 4e-4, "i_0": 2.0}},
        ],
        "controller": {
            "coordinates": "rigid-body",
            "compensate_gyroscopics": True,
            "observer": {"kind": "kalman", "w": 2000.0},
            "position": {"kind": "pid", "k_p": 5e5, "k_int": 5e7, "k_d": 1200.0, "w_f": 12000.0, "k_aw": 30.0},
            "tilt": {"observer": {"w": 2500.0}, "position": {"k_p": 7e5, "k_d": 1700.0}},
            "axial": {"position": {"k_int": 3e7}},
            "inversion": {"kind": "closed-form"},
            "current": {"kind": "pi"},
        },
        "sensor": {"velocity": False},
        "processor": processor(delay=1.0),
        "actuator": {"u_max": 40.0},
        "unbalance": [{"at": 0.1, "amount": 40.0, "phase": 30.0}],
        "initial": {"q": [2e-5, -3e-5, 1e-5, 1e-4, 5e-5]},
        "clock": CLOCK,
    },
}  # fmt: skip


# The linear magnets k_i = 50 N/A and k_s = 1e5 N/m of the Munich rig, and its controller (`Pid`, as pid.npz).
MUNICH = {
    "plant": {"mu_0": 1.2566e-6, "n": 208.0, "A": 50 * 0.78e-3**2 / 1.56 / 1.2566e-6 / 208.0**2, "s_0": 0.78e-3,
              "i_0": 1.56, "R": 0.0},
    "actuator": {"mode": "current", "bandwidth": 1e6},
    "controller": {"position": {"kind": "linear", "file": "pid.npz", "output": "current"},
                   "current": {"kind": "amplifier", "bandwidth": 1e6}},
    "clock": {"duration": 1e-3, "sample_period": 1e-6},
}  # fmt: skip


# Amplifiers without current: the magnets exert only what their bias gives.
OFF = {
    "controller": {"position": {"kind": "pid", "k_p": 1.0, "k_d": 1.0, "k_int": 1.0},
                   "inversion": {"kind": "linearised"}, "current": {"kind": "amplifier", "bandwidth": 1e3}},
    "actuator": {"mode": "current", "bandwidth": 1e3, "u_max": 1e-9},
    "run": {"settle": 0.0},
}  # fmt: skip


class Pid:
    """The published PID of the Munich rig: 5000 A/m, 1500 A/(m s), 5 A s/m; a pole of its derivative at 3e6 1/s."""

    w = 3e6
    A, B = np.array([[0.0, 0.0], [0.0, -w]]), np.array([[1.0], [1.0]])
    C, D = np.array([[1500.0, -5.0 * w * w]]), np.array([[5000.0 + 5.0 * w]])
