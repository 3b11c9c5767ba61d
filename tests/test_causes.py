"""Causes of a lost rotor and of an alternating voltage: a part is named only if the symptom is gone without it."""

import copy
import tomllib

import numpy as np
import pytest

import ambjax as amb
from ambjax.cases.reader import case_from
from ambjax.theorem import advice, sampled_report
from ambjax.theorem.causes import NO_PART, Cause, cause_words, find_cause, parts
from ambjax.theorem.sampled_report import Delays

EVERYTHING = """
plant = { kind = "two-coil", iron.leakage = 1.2 }
rotor.speed = 6000.0
controller.model = { m = 0.7 }
controller.observer = { kind = "kalman" }
controller.notch.rate = 5.0
disturbance.q_z = { kind = "step", amplitude = 1.0, start = 0.1 }
processor = { delay = 1.0, discretisation = "explicit" }
actuator = { u_max = 100.0, bandwidth = 5e3 }
initial = { z = 1e-4 }
clock = { sample_period = 1e-4, duration = 0.2 }
sensor = { std = 1e-7, bits = 12, bandwidth = 1e4, offset = 1e-6, velocity = false, outliers = { rate = 1.0 } }
"""
# Part, and whether a case still has it.
PARTS = {
    "the noise of the sensors": lambda c, s, k: bool(s.sensor.std),
    "the converter": lambda c, s, k: s.sensor.bits < 32,
    "the faults of the position sensor": lambda c, s, k: s.sensor.faulty,
    "the low-pass": lambda c, s, k: s.sensor.bandwidth is not None,
    "the calibration": lambda c, s, k: bool(s.sensor.offset),
    "the explicit steps": lambda c, s, k: not c.processor.implicit,
    "the guard": lambda c, s, k: c.processor.guard is not None,
    "the notch": lambda c, s, k: c.notch is not None,
    "the difference of controller.model": lambda c, s, k: c.model.m != s.plant.m,
    "the limit of the voltage": lambda c, s, k: np.isfinite(s.u_max),
    "the amplifier": lambda c, s, k: s.amplifier is not None,
    "the delay": lambda c, s, k: bool(c.processor.delay),
    "the iron": lambda c, s, k: s.plant.iron is not None,
    "the disturbances": lambda c, s, k: s.q_z.span(1.0) != (0.0, 0.0),
    "the start": lambda c, s, k: bool(s.initial.z),
    "the sample period": lambda c, s, k: k.sample_period > 5e-5,
}


def case_of(text):
    return case_from(tomllib.loads(text))


def test_every_part_is_taken_away_alone_and_named_only_if_the_symptom_goes_with_it():
    case = case_of(EVERYTHING)
    loop = case.cascade, case.scenario, case.clock
    assert all(has(*loop) for has in PARTS.values())
    for part, name in zip(parts(*loop), PARTS, strict=True):
        assert part.name.startswith(name)
        kept = {other for other, has in PARTS.items() if has(part.cascade, part.scenario, part.clock)}
        assert kept == PARTS.keys() - {name}
    told = []
    for name, has in PARTS.items():
        found = find_cause(has, *loop, told.append)
        assert found.part.startswith(name)
        assert len(found.tried) == list(PARTS).index(name)
        assert f"The cause is {name}" in cause_words(found, *advice.LOSS)
    assert len(told) == len(PARTS) * (len(PARTS) + 1) / 2  # one line before each run
    never = find_cause(lambda *case: True, *loop)
    assert (never.part, len(never.tried)) == (None, len(PARTS))
    words = cause_words(never, *advice.LOSS)
    assert words.startswith(NO_PART)
    assert "The cause is" not in words
    assert "Possible causes, not tested" in words


def test_a_case_without_parts_has_no_part_to_take_away():
    case = case_of("")
    assert not list(parts(case.cascade, case.scenario, case.clock))
    assert find_cause(lambda *case: True, case.cascade, case.scenario, case.clock) == Cause(None, "", ())


# Changes that lose the rotor of the rig, and the part to blame; the oracle takes it out of the case file by hand.
LOSSES = {
    "the noise of the sensors": ({"sensor": {"std": 1e-4, "bits": None}}, {"sensor": {"std": 0.0, "std_i": 0.0}}),
    "the limit of the voltage": ({"initial": {"z": 2e-4}, "actuator": {"u_max": 4.0}}, {"actuator": {"u_max": None}}),
    "the disturbances": ({"disturbance": {"q_z": {"amplitude": 400.0}}}, {"disturbance": None}),
    # a rate above 2/T = 4e4 1/s: the notch is not stable
    "the notch": ({"rotor": {"speed": 6e3}, "controller": {"notch": {"rate": 1e5}}}, {"controller": {"notch": None}}),
}


def changed(raw, change):
    """Return the tables of a case file with other values; None removes a key."""
    raw = copy.deepcopy(raw)
    for key, value in change.items():
        if value is None:
            raw.pop(key, None)
        else:
            raw[key] = changed(raw.get(key, {}), value) if isinstance(value, dict) else value
    return raw


def rig(**change):
    return changed(tomllib.loads(amb.template("rig")), {"clock": {"duration": 0.15}, "spread": None, **change})


def is_lost(raw):
    case = case_from(raw)
    return bool(np.isfinite(amb.rollout(case.cascade, case.scenario, case.clock, record_every=0).trajectory.lost_at))


def report_of(raw):
    case = case_from(raw)
    run = case.cascade, case.scenario, case.clock, case.settle
    return sampled_report.with_causes(sampled_report.check_sampled(*run), *run)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOSSES)
def test_the_cause_of_a_loss_is_the_part_without_which_the_rotor_is_held(name):
    change, without = LOSSES[name]
    raw = rig(**change)
    assert not is_lost(changed(raw, without))
    report = report_of(raw)
    assert np.isfinite(report.lost_at)
    assert report.cause.part.startswith(name)
    said = " ".join(advice.processor_lines(report, Delays(None, None, None, 0.1), None))
    assert f"The cause is {name}" in said


# The paper's plant on a processor with explicit steps, whose signs then chatter.
CHATTERING = """
controller.inversion = { gamma = 7.5e4 }
processor = { delay = 1.0, discretisation = "explicit" }
actuator = { u_max = 200.0 }
clock = { duration = 0.2, sample_period = 1e-4 }
"""
ALTERNATING = {
    # 44.7 % and 0.5 % with and without the converter
    "the converter": (rig(), {"sensor": {"bits": None}}),
    "the explicit steps": (tomllib.loads(CHATTERING), {"processor": {"discretisation": "implicit"}}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ALTERNATING)
def test_the_cause_of_an_alternating_voltage_is_the_part_without_which_it_does_not_alternate(name):
    raw, without = ALTERNATING[name]
    report = report_of(raw)
    assert report.alternates
    assert report.alternation_cause.part.startswith(name)
    calm = report_of(changed(raw, without))
    assert calm.alternating < 0.05 < report.alternating
    assert calm.alternation_cause is None
