"""Stable, held but not stable, lost: the verdicts in loops whose motion is known."""

import copy
import dataclasses
import json
import math

import jax
import numpy as np
import pytest
import test_check_processor as sampled
from profiles import thorough
from test_tuning_delay import CASE
from texts import write
from tomlkit import dumps

import ambjax as amb
from ambjax.__main__ import main
from ambjax.cases.reader import case_from
from ambjax.commands import study_report
from ambjax.ensemble import delays, run_ensemble
from ambjax.ensemble.blocks import BlockValues, quarters
from ambjax.ensemble.delays import at_delays, delay_margin
from ambjax.linear import quiet_run, stability
from ambjax.linear.stability import SMALL, Findings, Stability, stability_of
from ambjax.simulation.rollout import Result
from ambjax.simulation.trajectory import Trajectory

# Additional delays over which the model does not predict; the brute-force margin is 0.97 samples.
STABLE, CYCLE, GONE = 1.3, 1.51, 1.7


def case_of(**change):
    raw = copy.deepcopy(CASE)
    for key, value in change.items():
        raw[key] = raw.get(key, {}) | value
    return case_from(raw)


def members(case, n=1):
    return dataclasses.replace(case.scenario, member=np.zeros(n, int))


def late(case, delay):
    return at_delays(case.cascade, np.asarray(delay), known=False)


def loop(amplitude=0.0):
    """A case with a load and noise of 1 % of the clearance; one compiled program for all amplitudes (N)."""
    loads = {"q_z": {"kind": "sine", "amplitude": amplitude, "frequency": 30.0}}
    return case_of(disturbance=loads, sensor={"std": 4.5e-6})


def rolled(case, delay, quiet=True):
    """z and i of a run with this delay, of which the controller assumes half a sample."""
    world = case.scenario
    if quiet:
        world = dataclasses.replace(world, sensor=world.sensor.louder(0.0), initial=amb.Initial(2.5e-5))
    one = dataclasses.replace(late(case, [delay]).processor, delay=delay, assumed=0.5)
    run = amb.rollout(dataclasses.replace(case.cascade, processor=one), world, case.clock).trajectory
    return np.asarray(run.rows.z), np.asarray(run.rows.i), run.lost_at


@pytest.mark.slow
def test_the_margin_and_the_stability_at_its_delays_share_a_compiled_program(caplog, monkeypatch):
    """The first test here: those below use this program, which is one for three members."""
    case = loop()
    monkeypatch.setattr(delays, "DELAYS", 3)
    margin = delay_margin(case.cascade, case.scenario, case.clock, known=False)
    try:  # in all threads
        jax.config.update("jax_log_compiles", True)
        stability_of(late(case, np.linspace(0.0, margin.held, 3)), case.scenario, case.clock)
    finally:
        jax.config.update("jax_log_compiles", False)
    compiled = [message.split()[1] for message in caplog.messages if message.startswith("Compiling ")]
    assert "jit(loop_matrices)" in compiled  # the linear loops
    assert "jit(marked)" not in compiled


@pytest.mark.slow
def test_below_the_margin_stable_above_it_held_but_not_stable_far_above_it_lost():
    case, tried = loop(), late(loop(), [STABLE, CYCLE, GONE])
    found = stability_of(tried, members(case, 3), case.clock)
    calm = dataclasses.replace(case.scenario, sensor=case.scenario.sensor.louder(0.0))
    ends = run_ensemble(tried, calm, case.clock, fold=quarters(case.clock)).trajectory.lost_at
    assert np.isinf(ends).tolist() == [True, True, False]
    assert found.stable.tolist() == [True, False, False]
    assert found.lost.tolist() == [False, False, True]
    assert np.sign(found.growth).tolist() == [-1, 1, 1]
    z, i, _ = rolled(case, CYCLE)
    assert found.swing[1] == pytest.approx(np.ptp(z[-50:]) / 2, rel=0.1)
    assert found.current[1] == pytest.approx(np.abs(i[-50:]).max(), rel=0.1)
    assert found.swing[1] > 0.1 * 5e-4  # a tenth of the gap
    assert found.current[1] > 2.0  # the bias current
    facts = found._replace(**{k: getattr(found, k)[:2] for k in Stability._fields[:-2]}).findings()
    assert (facts.tested, facts.unstable, facts.reason) == (2, 1, None)
    assert "1 of 2 members tested are held, but NOT stable" in facts.words()


@pytest.mark.slow
def test_noise_and_unbalance_do_not_make_a_loop_unstable():
    """Forced motion of a fifth of the clearance."""
    case = loop(25.0)
    z, _, lost_at = rolled(case, 0.5, quiet=False)
    assert np.isinf(lost_at)
    assert np.ptp(z[250:]) / 2 > 0.15 * case.scenario.touchdown
    found = stability_of(late(case, [0.5] * 3), members(case, 3), case.clock)
    assert found.stable.all()
    assert found.swing.max() < 1e-3 * SMALL * case.scenario.touchdown


def test_a_quiet_run_has_no_load_and_the_compiled_program_of_its_case():
    loads = {
        "q_z": amb.signals.Sum((amb.signals.Sine(2.0, 30.0, 1.0), amb.signals.Ramp(3.0, 0.0, 0.1))),
        "q_v": amb.signals.Pulse(1.0, 0.0, 0.1),
        "q_f": amb.signals.Unbalance(120.0, 1.0),
        "reference": amb.signals.Constant(np.array([1e-5, 2e-5])),  # of two members
    }
    noisy = case_of(sensor={"std": 1e-6, "bits": 12}).scenario
    scenario = dataclasses.replace(noisy, rotor=amb.signals.Rotation(3000.0), **loads)
    for calm in (quiet_run.quiet(scenario), quiet_run.calmed(scenario, 1.0)):
        assert jax.tree.structure(calm) == jax.tree.structure(scenario)
        assert not np.any(calm.sensor.noises)
        assert abs(calm.initial.z - scenario.initial.z) == pytest.approx(0.01 * scenario.touchdown)
        np.testing.assert_array_equal(calm.reference.value, loads["reference"].value)
        for t in (0.0, 0.05, 0.3):
            assert scenario.turning().acceleration(t) != 0
            assert calm.turning().acceleration(t) == 0
    unchanged = quiet_run.calmed(scenario, 0.0)
    assert jax.tree.all(jax.tree.map(np.array_equal, unchanged, scenario))


@pytest.mark.slow
def test_the_chatter_of_signs_is_not_called_unstable():
    """Set-valued signs that act up to a sample late, and steep signs with explicit steps."""
    delay, clock = np.array([0.25, 0.5, 0.75, 1.0]), amb.Clock(2000, 1e-4, amb.solvers.RK4(1))
    cascade = sampled.loop_with(*sampled.HARD, delay=delay, predict=False).on_processor(2.0, 0.0, between=True)
    world = dataclasses.replace(sampled.WORLD, member=np.zeros(4, int))
    found = stability_of(cascade, world, clock)
    assert found.stable.all()
    assert np.isnan(found.growth).all()
    explicit = sampled.loop_with(200.0, 25.0, 2e5, 2000.0, 25.0, delay=0.0, implicit=False)
    found = stability_of(explicit, dataclasses.replace(world, member=np.zeros(1, int)), clock)
    assert found.growth[0] > 1000
    assert found.stable.all()
    assert "it chatters" in found.findings().reason


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["creep", "slow decay", "limit cycle"])
def test_only_an_oscillation_that_the_linear_loop_does_not_explain_is_sustained(motion, monkeypatch):
    """The run is constructed: z in each quarter, with an amplitude of 5 % of the clearance."""
    case = case_of()
    t, size = np.linspace(0, 1, 400).reshape(4, 100), 0.05 * case.scenario.touchdown
    oscillation = size * np.sin(2 * np.pi * 40 * t)
    z = {"creep": 8 * size * t, "slow decay": oscillation * np.exp(-0.2 * t)}.get(motion, oscillation)
    values = BlockValues(
        {"z": z.min(1)[None], "i": -np.ones((1, 4))}, {"z": z.max(1)[None], "i": np.ones((1, 4))}, None, None
    )
    run = Result(Trajectory(None, np.array([np.inf]), np.zeros(1), None), values)
    monkeypatch.setattr(quiet_run, "run_ensemble", lambda *_, **__: run)
    rate = -0.2 / float(case.clock.duration) if motion == "slow decay" else -50.0
    monkeypatch.setattr(stability, "_growth", lambda *_: np.array([rate]))
    assert stability_of(case.cascade, members(case), case.clock).stable[0] == (motion != "limit cycle")


@pytest.mark.slow
@pytest.mark.parametrize("position", [thorough({"kind": "pid"}), {"kind": "sliding-mode", "p": math.inf}])
def test_a_current_loop_that_alternates_between_the_limits_of_the_supply_is_not_stable(position):
    """Its gain is far too high. The rotor hardly moves, but no sign of a law causes that, also if the loop has one."""
    laws = {"position": position, "inversion": {"kind": "closed-form"}, "current": {"kind": "pi", "k_p": 2000.0}}
    clock = {"duration": 0.05, "sample_period": 5e-5}
    case = case_of(controller=laws, actuator={"mode": "voltage", "bandwidth": None, "u_max": 72.0}, clock=clock)
    found = stability_of(case.cascade, members(case), case.clock)
    assert found.swing[0] < SMALL * case.scenario.touchdown
    assert found.growth[0] > 1000
    assert not found.stable[0]
    assert "the limit of the supply" in found.findings().reason


@pytest.mark.slow
def test_a_limit_cycle_that_the_linear_loop_does_not_have_is_found_and_explained():
    """A dead band of the amplifier: the linear loop, which has none, is stable."""
    change = {"actuator": {"mode": "voltage", "bandwidth": None, "dead_band": 0.8}}
    case = case_of(**change, controller=CASE["controller"] | {"current": {"kind": "pi"}}, processor={"delay": 0.2})
    found = stability_of(case.cascade, members(case), case.clock)
    assert found.growth[0] < 0
    assert not found.stable[0]
    assert "The linear and the simulated verdict differ: the linear loop is stable" in found.findings().words()


def command(words, capsys):
    code = main([*words, "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.thorough
@pytest.mark.usefixtures("elsewhere")
def test_every_command_says_that_a_rotor_is_held_in_a_limit_cycle(capsys, monkeypatch):
    """Without prediction, the loop is stable up to 1.12 samples, and the rotor is held up to 1.33 samples."""
    monkeypatch.setattr(study_report, "_pictures", lambda *_: None)  # a fan is another program
    good, cycles = (
        write(dumps(CASE | {"processor": {"delay": d, "predict": False}}), f"{d}.toml") for d in (0.9, 1.25)
    )
    code, found = command(["check", cycles], capsys)
    assert (code, found["lost_at_s"], found["holds"]) == (1, None, False)
    facts = found["stability"]
    assert facts["unstable"] == 1
    assert found["processor"]["delay_margin"]["stable"] is None
    code, found = command(["ensemble", cycles, "--members", "2"], capsys)
    assert (code, found["survivors"]) == (1, 2)
    assert found["stability"]["unstable"] == 2
    # one loop, one limit cycle, in another program
    assert found["stability"]["swing_m"] == pytest.approx(facts["swing_m"], rel=0.05)
    code, found = command(["compare", good, cycles, "--members", "2"], capsys)
    assert [code, *(case["not_stable"] for case in found["cases"])] == [1, 0, 2]
    axes = ["--x", "processor.delay=0.9:1.6:3", "--y", "initial.z=1e-5:2e-5:2"]
    code, found = command(["map", cycles, *axes], capsys)
    (one,) = found["cases"]
    assert one["unstable"] == [[0, 1, 0]] * 2
    assert one["survival"] == [[1, 1, 0]] * 2
    assert one["reach"] == [0.9, 0.9]


ONE = Stability(*(np.array([x]) for x in (True, -10.0, False, 1e-9, 0.1, False)), 0.5, 2.0)
TABLE = {
    # growth, sustained, swing, lost, stable: whether the verdicts differ, and words
    "both stable": ((-10.0, False, 1e-9, False, True), None),
    "both not": ((50.0, True, 1e-4, False, False), None),
    "no linear verdict": ((math.nan, True, 1e-4, False, False), None),
    "no linear verdict, stable": ((math.nan, False, 1e-9, False, True), None),
    "a pole on the border": ((1e-6, False, 1e-9, False, True), None),
    "too slow": ((2.0, False, 1e-6, False, False), "too slowly to appear in a run of 0.5 s"),
    "chatter": ((1e4, False, 1e-6, False, True), "chatters"),
    "sustained": ((-10.0, True, 1e-4, False, False), "a nonlinearity sustains it"),
    "lost": ((-10.0, True, 4e-4, True, False), "outside the region in which the linear loop is valid"),
}


@pytest.mark.parametrize("name", TABLE)
def test_one_record_gives_the_verdict_and_the_reason(name):
    (growth, sustained, swing, lost, stable), reason = TABLE[name]
    values = {"growth": growth, "sustained": sustained, "swing": swing, "lost": lost, "stable": stable, "current": 3.0}
    facts = ONE._replace(**{key: np.array([value]) for key, value in values.items()}).findings()
    said = facts.words()
    assert facts.stable == stable == said.startswith("The loop is stable") == (facts.swing_m is None)
    assert ("NOT stable" in said) == (not stable)
    assert (facts.reason is None) == (reason is None)
    assert reason is None or reason in facts.reason
    assert ("differ" in said) == (reason is not None)
    assert stable or "3 A (bias 2 A)" in said
    assert not Findings(0, 0).words()  # no member tested is no verdict


def test_softer_signs_are_tried_for_the_loops_that_still_grow():
    """Of three loops that are excused, the first is stable with every sign, the second with the softest one only."""
    law, tried = amb.laws.position.SlidingMode(p=None), []

    def growth(cascades, chosen):
        p = cascades[0].position.p
        tried.append((p, chosen.tolist()))
        softest = p < 0.05 * tried[0][0]
        return np.where([False, not softest, True, True], 1e6, -1.0)[chosen]

    cascade, clock = amb.Cascade(position=law, processor=amb.Processor()), amb.Clock(1000)
    least = stability._least_growth([cascade], growth, np.array([True, True, True, False]), clock)
    np.testing.assert_array_equal(least, [-1.0, -1.0, 1e6, np.nan])
    assert tried[0][1] == [True, True, True, False]
    assert tried[1][1] == [False, True, True, False]
