"""Linear controllers from files: against python-control and SciPy, in continuous time and sampled, and bad files."""

import dataclasses
import pathlib
import pickle
import tomllib

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import scipy.signal
from texts import refusal

from ambjax import Cascade, Clock, Processor, Scenario, save_controller
from ambjax.cases.reader import read_case
from ambjax.control.realisation import MOST_STATES, realisation
from ambjax.ensemble.paths import kinds
from ambjax.laws import current, inversion, position
from ambjax.linear import linearise
from ambjax.plants import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference
from tuning.report.folder import tuned_case

MODEL, PERIOD = Plant(), 1e-4
W = 2 * np.pi * np.array([1.0, 30.0, 100.0, 700.0, 2e3])
S = control.tf("s")
# PID, notch and low-pass as one transfer function: its companion matrix spans 24 decades
PID = 135 + 5310 / S + 0.219 * S / (1 + S / 1.06e4)
NOTCH = (S**2 + 170 * S + 5650**2) / (S**2 + 1700 * S + 5650**2)
K = control.ss(PID * NOTCH * 2e4**2 / (S**2 + 2.8e4 * S + 2e4**2))


def of_k(system):
    return realisation(system.A, system.B, system.C, system.D, system.dt)


# --- the numbers ---


def test_a_realisation_has_the_response_of_the_state_space():
    # 1e-11: condition of the companion matrix after balancing
    np.testing.assert_allclose(of_k(K).response(W)[:, 0], K(1j * W), rtol=1e-11)
    # and of a discrete one at the frequencies that the bilinear transform maps to w
    found = of_k(control.ss([[0.5, 0.3], [-0.3, 0.2]], [[1.0], [2.0]], [[0.4, -1.0]], [[0.1]], PERIOD))
    s = 1j * np.tan(W * PERIOD / 2) * 2 / PERIOD
    wanted = control.ss([[0.5, 0.3], [-0.3, 0.2]], [[1.0], [2.0]], [[0.4, -1.0]], [[0.1]], PERIOD)
    np.testing.assert_allclose(found.response(np.imag(s))[:, 0], wanted(np.exp(1j * W * PERIOD)), rtol=1e-11)


def matrices(law, model, period=None):
    """Return A, B, C, D of the law from z to i_star, by differentiation."""

    def f(x, z):
        inputs = Measurement(z, 0.0, 0.0), Reference(0.0, 0.0, 0.0)
        v, after = law(model, inputs, tuple(x)) if period is None else law.step(model, inputs, tuple(x), period)
        i = (v - model.dv_dz(0.0, 0.0) * z) / model.dv_di(0.0, 0.0)
        return jnp.stack(after), i

    (A, B), (C, D) = jax.jacfwd(f, (0, 1))(jnp.zeros(len(law.realisation.A)), 0.0)
    return A, B[:, None], C[None], D[None, None]


@pytest.mark.parametrize("T", [None, PERIOD])
def test_the_law_is_python_control_s_system_with_negative_feedback(T):
    law = position.LinearController.of(K, gain=2.0)
    found = control.ss(*map(np.asarray, matrices(law, MODEL, T)), T or 0)
    at = 1j * W if T is None else np.exp(1j * W * T)
    wanted = K(1j * W) if T is None else K(2 / T * (at - 1) / (at + 1))  # Tustin, by substitution
    np.testing.assert_allclose(found(at), -2.0 * wanted, rtol=1e-9)


def test_a_discrete_controller_keeps_its_own_matrices():
    """Its step is x+ = A x + B w, y = C x + D w with the given matrices, so the outputs for any input are equal."""
    given = control.ss([[0.9, 0.2], [-0.3, 0.1]], [[1.0], [2.0]], [[0.4, -1.0]], [[0.1]], PERIOD)
    law, x, state = position.LinearController.of(given), np.zeros((2, 1)), None
    state = law.init(MODEL)
    for w in np.random.default_rng(0).normal(size=20) * 1e-4:
        v, state = law.step(MODEL, (Measurement(-w, 0.0, 0.0), Reference(0.0, 0.0, 0.0)), state, PERIOD)
        i = (v + MODEL.dv_dz(0.0, 0.0) * w) / MODEL.dv_di(0.0, 0.0) - MODEL.g / (MODEL.a * MODEL.dv_di(0.0, 0.0))
        np.testing.assert_allclose(i, (given.C @ x + given.D * w)[0, 0], rtol=1e-9, atol=1e-15)
        x = given.A @ x + given.B * w


def test_a_controller_with_two_inputs_receives_r_and_z():
    law = position.LinearController.of(control.ss([], [], [], [[3.0, -5.0]]))
    inputs = Measurement(2e-4, 0.0, 0.0), Reference(1e-4, 0.0, 0.0)
    i_star = inversion.Linearised().inverse(MODEL, inputs[0].z, law(MODEL, inputs, ())[0])
    weight = MODEL.g / (MODEL.a * MODEL.dv_di(0.0, 0.0))
    np.testing.assert_allclose(i_star, weight + 3 * 1e-4 - 5 * 2e-4, rtol=1e-12)


# --- the loop ---


VOLTS = control.tf2ss([4e4 * 3e5**2, 4e4 * 400 * 3e5**2], [1, 2 * 3e5, 3e5**2])
# the plant at z = 0: the nominal loop has no other equilibrium, for the rotor weighs nothing
FREE = dataclasses.replace(MODEL, g=0.0)
A_P = np.array([[0, 1, 0], [float(FREE.a * FREE.dv_dz(0.0, 0.0) + 2 * FREE.k_z / FREE.m), 0,
                            float(FREE.a * FREE.dv_di(0.0, 0.0))], [0, 0, float(-FREE.R / FREE.L)]])  # fmt: skip
P_U = control.ss(A_P, [[0], [0], [1 / float(FREE.L)]], [[1, 0, 0]], [[0]])  # from u to z


@pytest.mark.slow
def test_the_loop_with_a_voltage_output_is_python_control_s_feedback():
    law = position.LinearController.of(VOLTS, output="voltage")
    cascade = Cascade(position=law, inversion=inversion.Linearised(), current=current.OpenLoop(), model=FREE)
    found = linearise(cascade, Scenario(plant=FREE), Clock(10, PERIOD))
    np.testing.assert_allclose(found.sensitivity(W / 2 / np.pi), control.feedback(1, P_U * VOLTS)(1j * W), rtol=1e-8)
    # sampled, with one sample of delay, not predicted: zero-order hold, Tustin
    processor = Processor(1.0, predict=False)
    found = linearise(dataclasses.replace(cascade, processor=processor), Scenario(plant=FREE), Clock(10, PERIOD))
    z = np.exp(1j * W * PERIOD)
    held, bilinear = P_U.sample(PERIOD), VOLTS.sample(PERIOD, "tustin")
    np.testing.assert_allclose(found.sensitivity(W / 2 / np.pi), 1 / (1 + held(z) * bilinear(z) / z), rtol=1e-8)


# --- files ---

CASE = """
[controller.position]
kind = "linear"
file = "k.npz"
gain = 1.5                   # ours
[controller.inversion]
kind = "linearised"
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_controller("k.npz", K)
    pathlib.Path("case.toml").write_text(CASE)
    return tmp_path


def read(text):
    pathlib.Path("case.toml").write_text(text)
    return read_case("case.toml")


def test_a_controller_file_gives_the_same_law_as_python(folder):
    law = read_case("case.toml").cascade.position
    assert law == position.LinearController.of(K, gain=1.5)
    assert pickle.loads(pickle.dumps(law)) == law
    # of MATLAB, all numbers are matrices
    scipy.io.savemat("k.mat", {"A": K.A, "B": K.B, "C": K.C, "D": K.D, "dt": 0.0})
    assert read(CASE.replace("npz", "mat")).cascade.position == law
    # another controller is another study
    assert dict(kinds(law)) != dict(kinds(position.LinearController.of(2 * K, gain=1.5)))


def test_a_law_with_a_voltage_output_selects_stages_that_pass_it(folder):
    text = CASE.partition("[controller.inversion]")[0].replace("gain", 'output = "voltage"\ngain')
    laws = read(text).cascade.laws
    assert [type(x) for x in laws[2:]] == [inversion.Linearised, current.OpenLoop]
    with pytest.raises(ValueError, match=r"controller\.current = DeadBeat: it does not take the voltage .* Leave out"):
        read(text + '[controller.current]\nkind = "dead-beat"\n')
    with pytest.raises(ValueError, match=r"controller\.current = OpenLoop: it does not take the force"):
        read(CASE + '[controller.current]\nkind = "open-loop"\n')
    with pytest.raises(ValueError, match=r'controller\.position: output = "voltage" needs a coil resistance'):
        read(text + "[plant]\nR = 0.0\n")


def test_tuned_toml_finds_the_controller_from_its_own_folder(folder):
    one = read_case("case.toml")
    pathlib.Path("k.npz").rename("moved.npz")  # a change of the file during the search does not matter
    text, tuned = tuned_case(one, {"controller.position.gain": 2.0}, "held", pathlib.Path("there/deep"))
    assert tomllib.loads(text)["controller"]["position"]["file"] == "../../k.npz"
    pathlib.Path("moved.npz").rename("k.npz")
    pathlib.Path("there/deep").mkdir(parents=True)
    pathlib.Path("there/deep/tuned.toml").write_text(text)
    assert read_case("there/deep/tuned.toml").cascade.position == tuned.cascade.position
    assert tuned.cascade.position == dataclasses.replace(one.cascade.position, gain=2.0)


# What is in the file, and what the message contains.
ONE = {"A": [[-1.0]], "B": [[1.0]], "C": [[1.0]], "D": [[0.0]]}
WRONG = {
    "no array": ({"A": [[1.0]], "B": [[1.0]]}, ["array C is missing", "it has A, B"]),
    "not square": (ONE | {"A": [[1.0, 2.0]]}, ["A has the shape (1, 2)", "must be (1, 1)"]),
    "another B": (ONE | {"B": [[1.0], [2.0]]}, ["B has the shape (2, 1)", "must be (1, 1)"]),
    "two outputs": (ONE | {"D": [[1.0], [2.0]]}, ["D has the shape (2, 1)", "for the input r - z"]),
    "NaN": (ONE | {"B": [[np.nan]]}, ["B contains NaN or inf"]),
    "too many": (ONE | {"A": -np.eye(MOST_STATES + 1)}, [f"A has {MOST_STATES + 1} rows", "Reduce its order"]),
    "dt negative": (ONE | {"dt": -1.0}, ["dt = -1.0", "sample period in seconds"]),
    "a pole at -1": (ONE | {"dt": 1e-4}, ["A has an eigenvalue near -1"]),
    "pickled": ({"A": np.array([None])}, ["not an .npz file of plain numbers"]),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_file_is_refused_in_one_line(wrong, folder, capsys):
    arrays, wanted = WRONG[wrong]
    np.savez("k.npz", **arrays)
    said = refusal(capsys, "simulate", "case.toml")
    assert all(part in said for part in ('case.toml: controller.position.file = "k.npz": ', *wanted)), said


def test_a_missing_file_or_period_is_refused_in_one_line(folder):
    for text, wanted in {
        CASE.replace("k.npz", "no.npz"): r"file = \"no\.npz\": .*cannot be read \(No such file.*relative to the folder",
        CASE.replace("k.npz", "k.txt"): r"file = \"k\.txt\": it must be the path of an \.npz or \.mat",
        CASE.replace('file = "k.npz"\n', ""): r"controller\.position\.file is missing",
        CASE.replace("gain", 'output = "force"\ngain'): r"output = \"force\": it must be one of 'current' or 'voltage'",
    }.items():
        with pytest.raises(ValueError, match=wanted):
            read(text)
    pathlib.Path("k.mat").write_bytes(b"no such thing")
    with pytest.raises(ValueError, match=r"not a \.mat file"):
        read(CASE.replace("npz", "mat"))
    save_controller("k.npz", VOLTS.sample(PERIOD, "tustin"))
    with pytest.raises(ValueError, match=r"controller\.position: the controller is discrete, .*Add \[processor\]"):
        read(CASE)
    with pytest.raises(ValueError, match=r"discrete, dt = 0\.0001 s, and the sample period is 5e-05 s"):
        read(CASE + "[processor]\n[clock]\nsample_period = 5e-5\n")
    assert read(CASE + "[processor]\n").cascade.position.realisation.dt == PERIOD
    improper = scipy.signal.TransferFunction([1.0, 0.0], [1.0])
    for wrong in (np.eye(2), improper, control.tf([[[1.0], [1.0]]], [[[1.0, 1.0], [2.0, 1.0]]])):
        for take in (position.LinearController.of, lambda system: save_controller("k.npz", system)):
            with pytest.raises(ValueError, match=r"system = .*: it must be a state space .* one input and one output"):
                take(wrong)
    with pytest.raises(ValueError, match=r"must end in \.npz or \.mat"):
        save_controller("k.csv", K)


@pytest.mark.parametrize("kind", [control.tf, scipy.signal.TransferFunction])
@pytest.mark.parametrize("ending", ["npz", "mat"])
def test_a_transfer_function_is_a_controller(kind, ending, tmp_path, monkeypatch):
    """K(s) = (3 s + 5)/(s^2 + 2 s + 7), also after it was saved."""
    monkeypatch.chdir(tmp_path)
    K = kind([3.0, 5.0], [1.0, 2.0, 7.0])
    save_controller(f"k.{ending}", K)
    saved = read(CASE.replace("npz", ending)).cascade.position
    for law in (position.LinearController.of(K), saved):
        wanted = (3j * W + 5) / ((1j * W) ** 2 + 2j * W + 7)
        np.testing.assert_allclose(law.realisation.response(W)[:, 0], wanted, rtol=1e-9)
