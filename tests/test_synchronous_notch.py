"""The notch at the speed of the rotor: what it removes, how fast, and in every form of the controller."""

import dataclasses
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough

from ambjax.cases.machine_case import machine_from, read_machine
from ambjax.cases.reader import case_from
from ambjax.cases.table import Table
from ambjax.cases.template_text import template
from ambjax.codegen.c99.source import Origin
from ambjax.codegen.loop_step import block_of
from ambjax.codegen.verify import draft, holds, verify
from ambjax.control.synchronous_notch import NotchGain, NotchState, SynchronousNotch
from ambjax.ensemble.maps import PERIOD
from ambjax.linear import linearise
from ambjax.linear.linear_machine import linearise_machine
from ambjax.linear.margins import poles_in_s
from ambjax.results.case_gains import with_gains
from ambjax.results.case_map import study_and_axes
from ambjax.results.cell_gains import notch_gains
from ambjax.results.runs import simulate, simulate_machine
from ambjax.world.rotation import Rotation
from ambjax.world.sensor import Measurement
from tuning.problem import members as members_of
from tuning.problem.config import tune_from
from tuning.problem.tuning_problem import problem_of

RATE, RPM = 40.0, 6000.0
LAWS = {
    "position": {"kind": "pid", "k_p": 1e5, "k_d": 800.0, "k_int": 1e-3},
    "inversion": {"kind": "closed-form"},
    "current": {"kind": "pi"},
}
# A force of 1e-4 of the weight: the nonlinear loop is its linearisation to 1e-6.
TURNING = {
    "controller": LAWS,
    "rotor": {"speed": RPM},
    "disturbance": {"q_z": {"kind": "unbalance", "unbalance": 0.05, "phase": 0.2}},
    "clock": {"duration": 0.36, "sample_period": 1e-4},
    "run": {"settle": 0.33},
}
ON_PROCESSOR = TURNING | {"processor": {"delay": 1.0}}


def with_notch(raw, kind, **more):
    notch = {"kind": kind, "rate": RATE} | more
    return raw | {"controller": raw.get("controller", {}) | {"notch": notch}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("raw", "kind", "nulled", "other"),
    [(TURNING, "force-free", "i_1x_A", "z_1x_m"), thorough(ON_PROCESSOR, "displacement-free", "z_1x_m", "i_1x_A")],
)
def test_the_notch_removes_the_speed_from_one_signal(raw, kind, nulled, other):
    # the second one is off: the same compiled program
    on, off = (simulate(case_from(with_notch(raw, kind, min_speed=rpm))).metrics for rpm in (0.0, 2 * RPM))
    # exp(-40 * 0.33) = 2e-6 of what the start contains
    assert on[nulled] < 1e-4 * off[nulled]
    assert on[other] > 0.3 * off[other]


@pytest.mark.slow
@pytest.mark.parametrize("raw", [TURNING, ON_PROCESSOR])
def test_the_linear_loop_contains_the_notch(raw):
    """A pole at -rate +- j W for a small rate; no response of the nulled reading at the speed."""
    for rate in (0.2, 2.0):
        case = case_from(with_notch(raw, "force-free", rate=rate))
        system = linearise(case.cascade, case.scenario, case.clock)
        assert np.max(np.abs(system.response(np.array([RPM / 60]))[0, 5])) < 1e-9 * np.max(
            np.abs(linearise(dataclasses.replace(case.cascade, notch=None), case.scenario, case.clock)
                   .response(np.array([RPM / 60]))[0, 5])
        )  # fmt: skip
        poles = poles_in_s(system)
        # the loop changes G within the band `rate`: an error of the order of rate^2
        expected = -rate + 2j * np.pi * RPM / 60
        assert np.min(np.abs(poles - expected)) < 0.003 * rate**2 + 1e-4 * rate


@pytest.mark.slow
def test_the_phase_must_be_right_within_a_quarter_of_a_turn():
    """A notch with a phase 80 degrees off converges, at 100 degrees it is not stable; `phase` replaces the phase."""
    case = case_from(with_notch(ON_PROCESSOR, "displacement-free", rate=1.0))
    (gain,) = case.cascade.notch.gains
    right = -np.degrees(np.angle(complex(gain.real, gain.imaginary)))
    for off, stable in ((80.0, True), (100.0, False), (-80.0, True), (-100.0, False)):
        phase = (right + off + 180) % 360 - 180
        one = case_from(with_notch(ON_PROCESSOR, "displacement-free", rate=1.0, phase=phase))
        assert linearise(one.cascade, one.scenario, one.clock).stable == stable


def band(rotation):
    gains = NotchGain(2000.0, 0.5, 0.2), NotchGain(4000.0, 0.7, -0.1)
    return SynchronousNotch("displacement-free", RATE, 2000.0, 4000.0, gains, rotation, True)


def reading(z):
    return Measurement(z, 0.0, 0.0)


def test_a_notch_is_on_in_a_band_of_speeds_and_vanishes_as_exp():
    """The amplitude |c| of a run-up through the band: 0 below it, no jump anywhere, exp(-rate t) above it."""
    T, count = 1e-3, 1200
    rotation = Rotation(1000.0, 5000.0)  # 2000 rpm at 0.2 s, 4000 rpm at 0.6 s
    notch, z = band(rotation), np.cos(2 * np.pi * np.asarray(rotation.turns(T * np.arange(count))))

    def step(state, z):
        added, after = notch.step(reading(z), state, T)
        return after, (added - z, jnp.hypot(state.real, state.imaginary))

    start = notch.init(reading(jnp.asarray(0.0)))
    _, (added, size) = jax.jit(lambda z: jax.lax.scan(step, start, z))(z)
    added, size, t = np.asarray(added), np.asarray(size), T * np.arange(count)
    assert np.all(size[t < 0.2] == 0)
    assert np.all(np.abs(added) <= size + 1e-12)
    assert np.ptp(added[(t > 0.5) & (t < 0.6)]) > 1.0
    assert np.all(np.abs(np.diff(size)) <= RATE * T * (2 * 0.75 + size[:-1]))
    after = t > 0.602
    np.testing.assert_allclose(np.diff(np.log(size[after])), np.log(1 - RATE * T), rtol=1e-6)


@pytest.mark.parametrize("rpm", [1500.0, 3000.0, 5000.0])
def test_short_steps_of_a_notch_equal_its_rate(rpm):
    notch, h = band(Rotation(rpm)), 1e-7
    state = NotchState(*map(jnp.asarray, (0.3, -0.2, 0.05, 0.0)))
    added, rate = notch(reading(0.4), state)
    same, after = notch.step(reading(0.4), state, h)
    assert added == same == pytest.approx(0.7)
    np.testing.assert_allclose((np.array(after)[:3] - np.array(state)[:3]) / h, rate[:3], rtol=1e-4, atol=1e-3)
    assert (after.elapsed, rate.elapsed) == (1.0, 1.0)  # samples; seconds


def test_a_notch_in_float32_turns_with_the_rotor_for_hours():
    """Ten million samples after the start of a run-up, the angle of one sample is still right to rounding."""
    period, rotor = 2e-5, Rotation(3000.0, 10.0, 9000.0)  # 5000 rpm after 200 s
    notch = jax.tree.map(jnp.float32, dataclasses.replace(band(rotor), max_speed=1e7, min_speed=1e7))  # off: it turns
    state = NotchState(*map(jnp.float32, (1.0, 0.0, 0.0, 1e7)))
    _, after = notch.step(jax.tree.map(jnp.float32, reading(0.0)), state, jnp.float32(period))
    turned = np.arctan2(after.imaginary, after.real)
    assert turned == pytest.approx(2 * np.pi * 5000 / 60 * period, rel=1e-6)
    assert after.elapsed == 1e7 + 1


@pytest.mark.slow
@pytest.mark.parametrize("rotor", [thorough({"speed": RPM}), {"speed": 3000.0, "acceleration": 1e4}])
def test_the_exported_notch_equals_the_simulated_one(tmp_path, rotor):
    case = case_from(with_notch(ON_PROCESSOR | {"rotor": rotor}, "force-free"))
    controller = block_of("controller", case.cascade, case.scenario, case.clock)
    names = [number.name for number in controller.numbers()]
    assert "controller.notch.rotor.speed" in names or "notch.rotor.speed" in names
    made = draft(controller, "double", "notch", Origin("test", "0" * 64, controller.described()), 2000)
    assert holds(verify({"double": made}, None))


# compiles faster than the laws of the template, as does a processor without prediction
QUICK = {"position": {"kind": "pid"}, "inversion": {"kind": "linearised"}}


def of_machine(bearings=(), **controller):
    """A machine at RPM under an unbalance; `bearings`: the notch of each of the first ones; `controller`: or QUICK."""
    raw = tomllib.loads(template("machine"))
    raw["rotor"] |= {"speed": RPM}
    raw["controller"] = (raw["controller"] if "coordinates" in controller else {}) | (controller or QUICK)
    raw["processor"] |= {} if controller else {"predict": False}
    for one, notch in zip(raw["bearing"], bearings, strict=False):
        one["controller"] = {"notch": notch}
    return raw | {"clock": raw["clock"] | {"duration": 0.3}, "run": {"settle": 0.25}, "load": [], "initial": {},
                  "sensor": {"velocity": not controller}, "unbalance": [{"at": 0.05, "amount": 0.1}]}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("controller", [{"coordinates": "rigid-body"}, {"kind": "lqg"}])
def test_each_bearing_of_a_machine_has_its_own_notch(controller):
    """One law of all axes: no current at the speed on the left, no displacement on the right, no notch along z."""
    notches = {"rate": 40.0}, {"kind": "displacement-free", "rate": 40.0}, {"kind": "none"}
    case = machine_from(of_machine(notches, **controller))
    axes = simulate_machine(case).metrics["axes"]
    # exp(-40 * 0.25) = 5e-5 of what the start contains
    for axis in ("x", "y"):
        left, right = axes[f"left.{axis}"], axes[f"right.{axis}"]
        assert left["i_1x_A"] < 1e-2 * right["i_1x_A"]
        assert right["z_1x_m"] < 1e-2 * left["z_1x_m"]
    system = linearise_machine(case.machine, case.clock.sample_period, RPM)
    H = np.abs(np.asarray(system.response(np.array([RPM / 60])))[0])
    assert np.max(H[10:12, :5]) < 1e-9 * np.max(H[12:14, :5])  # currents
    assert np.max(H[2:4, :5]) < 1e-9 * np.max(H[:2, :5])  # readings
    assert H[14, 4] > 1e-3 * np.max(H[12:14, :5])
    poles = poles_in_s(system) - 2j * np.pi * RPM / 60
    assert np.sort(np.abs(poles + 40.0))[3] < 20.0  # four notches converge with about their rate


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        ({"controller": {"notch": {"kind": "force-free"}}}, r"\[controller.notch\]: it follows the speed of the rotor"),
        (TURNING | {"controller": {"notch": {"kind": "free"}}}, "controller.notch.kind = .*one of 'force-free'"),
        (with_notch(TURNING, "force-free", rate=0.0), "controller.notch.rate = 0: it must be"),
    ],
)
def test_a_wrong_notch_is_refused(raw, said):
    with pytest.raises(ValueError, match=said):
        case_from(raw)


def test_a_wrong_notch_of_a_bearing_is_refused():
    with pytest.raises(ValueError, match=r"axis right.x: controller.notch.kind = .*one of 'force-free'"):
        machine_from(of_machine(({"kind": "none"}, {"kind": "free"})))


GAINS = {"controller.position.k_p": 1.5e5, "controller.position.k_d": 500.0}


def of_gains(notches):
    return np.array([(gain.real, gain.imaginary) for gain in notches])


def reread():
    """The case with other gains, read from its tables."""
    laws = LAWS | {"position": LAWS["position"] | {"k_p": 1.5e5, "k_d": 500.0}}
    return case_from(with_notch(ON_PROCESSOR | {"controller": laws}, "force-free"))


@pytest.mark.slow
def test_the_notch_of_a_case_follows_its_gains():
    case, expected = case_from(with_notch(ON_PROCESSOR, "force-free")), of_gains(reread().cascade.notch.gains)
    before = of_gains(case.cascade.notch.gains)
    assert np.abs(before - expected).max() > 0.1 * np.abs(expected).max()  # so that the test can fail
    assert of_gains(with_gains(case, GAINS).cascade.notch.gains) == pytest.approx(expected, rel=1e-6)
    named = {"controller.notch.gains.0.real": 2.0}
    assert with_gains(case, GAINS | named).cascade.notch.gains[0].real == 2.0

    def real(k_p):
        return with_gains(case, GAINS | {"controller.position.k_p": k_p}).cascade.notch.gains[0].real

    step = 1e-2 * 1.5e5  # the error of the difference is 1e-6
    difference = (real(1.5e5 + step) - real(1.5e5 - step)) / (2 * step)
    assert jax.jit(jax.grad(real))(1.5e5) == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.slow
def test_the_tuner_simulates_the_notch_that_its_answer_has(monkeypatch):
    """The terms of the loss and the linear peak at other gains are those of the case that is read with them.

    The notch is designed once for all members.
    """
    designed, design = set(), members_of._designs
    monkeypatch.setattr(
        members_of, "_designs", lambda x, *rest, **more: designed.add(len(x)) or design(x, *rest, **more)
    )
    short = {"clock": {"duration": 0.02, "sample_period": 1e-4}, "run": {"settle": 0.01}}
    raw = with_notch(ON_PROCESSOR, "force-free") | short
    tune = {"gains": list(GAINS), "members": 2, "stressed": 2, "validation": 0}

    def problem(case, raw):
        return problem_of(case, tune_from(Table(raw | {"tune": tune}).table("tune"), case))

    laws = LAWS | {"position": LAWS["position"] | {"k_p": 1.5e5, "k_d": 500.0}}
    other = with_notch(raw | {"controller": laws}, "force-free")
    found = []
    for one in (raw, other):
        own = problem(case_from(one), one)
        members = own.objective.training(0, 2, 2, 1.5, 1.1)
        x = own.objective.space.encode(np.array(list(GAINS.values())))
        fixed = own.objective.fixed(x, members)[0].notch.gains
        found.append((own.engine.terms(x[None], members), fixed))
    assert designed == {1}
    (terms, gains), (expected, rest) = found
    for name, values in terms.items():
        assert values == pytest.approx(expected[name], rel=1e-6), name
    assert of_gains(gains) == pytest.approx(of_gains(rest), rel=1e-6)


@pytest.mark.slow
def test_a_notch_has_gains_at_all_speeds_that_vary():
    """At the ends of a spread, and at the analysed speeds, the gain is the inverse of the response there."""
    raw = with_notch(ON_PROCESSOR, "force-free") | {"spread": {"rotor": {"speed": {"uniform": [3000.0, 9000.0]}}}}
    gains = case_from(raw).cascade.notch.gains
    assert [float(gain.speed) for gain in (gains[0], gains[-1])] == [3000.0, 9000.0]
    for k, rpm in ((0, 3000.0), (-1, 9000.0)):
        alone = case_from(with_notch(ON_PROCESSOR | {"rotor": {"speed": rpm}}, "force-free")).cascade.notch.gains
        assert of_gains(gains)[k] == pytest.approx(of_gains(alone)[0], rel=1e-9)
    machine = of_machine(({"rate": 10.0}, {"rate": 10.0}, {"kind": "none"})) | {"sensitivity": {"speeds": [4000.0]}}
    gains = machine_from(machine).cases[0].cascade.notch.gains
    assert [float(gain.speed) for gain in (gains[0], gains[-1])] == [4000.0, RPM]


@pytest.mark.slow
def test_a_notch_follows_the_speed_of_each_member():
    """A notch has a state for a speed that changes in some members, though that of the case is constant."""
    faster = {"spread": {"rotor": {"acceleration": {"uniform": [0.0, 1e4]}}}}
    assert case_from(with_notch(ON_PROCESSOR, "force-free") | faster).cascade.notch.varying
    machine = machine_from(of_machine(({"rate": 10.0}, {"kind": "none"}, {"kind": "none"})) | faster)
    assert machine.cases[0].cascade.notch.varying
    assert machine.cases[2].cascade.notch is None


@pytest.mark.slow
@pytest.mark.parametrize("y", ["rotor.speed=3000:9000:2", "clock.sample_period=5e-5:1e-4:2"])
def test_the_notches_in_the_map_of_a_machine_are_those_of_each_cell(y):
    """The gains are those of the machine that is read with the numbers of the cell."""

    def machine(k_int, speed=RPM, period=5e-5):
        raw = of_machine(({"rate": 10.0}, {"kind": "displacement-free"}, {"kind": "none"}))
        raw["controller"] = QUICK | {"position": {"kind": "pid", "k_int": k_int}}
        clock = raw["clock"] | {"sample_period": period}
        return raw | {"clock": clock, "rotor": raw["rotor"] | {"speed": speed}, "sensitivity": {"speeds": [speed]}}

    path, _, values = y.partition("=")
    study, *_ = study_and_axes(read_machine(machine(1e7)), "controller.position.k_int=1e6:1e7:2", y, 1, None)
    low = float(values.split(":")[0])
    if path == PERIOD:
        study, own, other = study.at(PERIOD, low), {PERIOD: np.full(2, low)}, machine(1e6, period=low)
    else:
        own, other = {path: np.array([9000.0, low])}, machine(1e6, low)
    laws = {part: np.array([1e7, 1e6]) for part in study.parts("controller.position.k_int")}
    found = notch_gains(study, laws | own)
    for axis, one in zip(study.case.axes, machine_from(other).cases, strict=True):
        for name in ("real", "imaginary") if one.cascade.notch else ():
            expected = float(getattr(one.cascade.notch.gains[0], name))
            gains = f"bearing.{axis}.controller.notch.gains.0.{name}"
            assert found[gains][1] == pytest.approx(expected, rel=1e-6)
