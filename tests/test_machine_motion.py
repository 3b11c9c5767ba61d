"""A spinning rotor along a simulated trajectory: closed forms, what is conserved, and reciprocity."""

import numpy as np
import pytest
from machine_cases import OFF

from ambjax.cases.machine_case import machine_from
from ambjax.results.machine_run import simulate_machine

M, I_T, I_P, W = 3.0, 0.1, 0.04, 1000 * np.pi
MODE = 2 * np.pi * 150.0
PLACES, SHAPES = (-0.2, 0.0, 0.2), (0.5, -0.4, 0.3)
MAGNET = {"mu_0": 1.2566e-6, "n": 208.0, "A": 2.68e-4, "s_0": 5e-4, "R": 1.0}
# What couples the mode to the tilt, and the mode to itself.
COUPLED = 0.2, 0.1


def moved(i_0=1e-6, shapes=SHAPES, W=W, gyroscopic=COUPLED, tilt=0.0, pulse=0, way=(0.6, 0.8)):
    """Signals of a rotor with one undamped mode, whose magnets have the bias i_0 (A) and no control current.

    It starts with a tilt beta_x. A pulse of 10 N acts at a bearing from 1 to 2 ms.
    """
    own = [{"name": name, "kind": "radial", "at": at, "modes": [shape]}
           for name, at, shape in zip("abc", PLACES, shapes, strict=True)]  # fmt: skip
    between, alone = gyroscopic
    raw = OFF | {
        "plant": MAGNET | {"i_0": i_0},
        "rotor": {"kind": "modal", "m": M, "I_t": I_T, "I_p": I_P, "gravity": [0.0] * 3, "speed": W * 30 / np.pi,
                  "modes": [{"frequency": MODE / (2 * np.pi), "damping": 0.0}],
                  "Gm": [[0.0] * 3, [0.0, I_P / I_T, between], [0.0, between, alone]]},
        "bearing": own,
        "load": [{"at": PLACES[pulse], "modes": [shapes[pulse]], "direction": [*way, 0.0], "kind": "pulse",
                  "amplitude": 0.0 if tilt else 10.0, "start": 1e-3, "stop": 2e-3}],
        "initial": {"q": [0.0, 0.0, 0.0, tilt, 0.0, 0.0, 0.0]},
        "clock": {"duration": 0.02, "sample_period": 5e-5, "dt": 5e-5},
    }  # fmt: skip
    return simulate_machine(machine_from(raw)).signals


def complex_rates(signals, shapes):
    """x' + j y' of the centre, beta_y' - j beta_x', and the rate of the mode, from the velocities at the bearings."""
    rows = np.stack([np.ones(3), PLACES, shapes], 1)
    z_dot = signals["z_dot"]
    return np.linalg.solve(rows, (z_dot[:, ::2] + 1j * z_dot[:, 1::2]).T)


@pytest.mark.slow  # the runs share one program
def test_a_top_nutates_and_precesses():
    """Negative springs at the magnets: I_t b'' - j W I_p b' = k b. Without the spin the rotor falls."""
    i_0, start = 1.0, 1e-6
    q = moved(i_0, (0.0, 0.0, 0.0), gyroscopic=(0.0, 0.0), tilt=start)["q"]
    t = 5e-5 * np.arange(len(q))
    k = 2 * PLACES[2] ** 2 * MAGNET["mu_0"] * MAGNET["n"] ** 2 * MAGNET["A"] * i_0**2 / MAGNET["s_0"] ** 3
    mean, half = W * I_P / (2 * I_T), np.sqrt((W * I_P) ** 2 - 4 * I_T * k) / (2 * I_T)
    fast, slow = mean + half, mean - half
    b = -1j * start * (fast * np.exp(1j * slow * t) - slow * np.exp(1j * fast * t)) / (fast - slow)
    np.testing.assert_allclose(q[:, 4] - 1j * q[:, 3], b, rtol=0, atol=1e-4 * start)


@pytest.mark.slow
def test_a_free_rotor_keeps_energy_and_momentum():
    signals = moved(pulse=2)
    v, tilting, bending = complex_rates(signals, SHAPES)
    q = signals["q"]
    b, mode = q[:, 4] - 1j * q[:, 3], q[:, 5] + 1j * q[:, 6]
    impulse = 10.0 * (0.6 + 0.8j) * 1e-3
    after = slice(41, None)  # from 2 ms on
    np.testing.assert_allclose(M * v[after], impulse, rtol=1e-6)
    # the moment of the gyroscopic couple is the rate of I_p W b, and of the coupling with the mode
    couple = 1j * W * (I_P * b + np.sqrt(I_T) * COUPLED[0] * mode)
    np.testing.assert_allclose((I_T * tilting - couple)[after], PLACES[2] * impulse, rtol=1e-6)
    parts = np.stack(
        [M * np.abs(v) ** 2, I_T * np.abs(tilting) ** 2, np.abs(bending) ** 2, MODE**2 * np.abs(mode) ** 2]
    )
    energy = np.sum(parts, 0)[after]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-5)
    assert np.ptp(parts[1:, after], 1).min() > 0.05 * energy[0]  # they exchange it


@pytest.mark.slow
def test_a_rotor_at_rest_is_reciprocal():
    """x at a after a pulse along (3, 4) at c is the motion along (3, 4) at c after a pulse along x at a; no spin."""
    for speed, equal in ((0.0, True), (W, False)):
        at_a = moved(W=speed, pulse=2)["z"][:, 0]
        at_c = moved(W=speed, pulse=0, way=(1.0, 0.0))["z"][:, 4:] @ (0.6, 0.8)
        assert (np.abs(at_a - at_c).max() < 1e-6 * np.abs(at_a).max()) == equal
