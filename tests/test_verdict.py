"""The advice of `ambjax check` and `ambjax simulate`: the gain to change, its new value, and whether that helps."""

import dataclasses
import math
import re

import pytest
from texts import write

from ambjax.__main__ import main
from ambjax.cases.template_text import template
from ambjax.commands import simulate
from ambjax.simulation.trajectory import STALLED, TOUCHED
from ambjax.theorem import advice, sampled_report
from ambjax.theorem.conditions import Condition, Report

SHORT = "[reference]\nkind = 'sine'\namplitude = 2.5e-3\nfrequency = 2.0\n[clock]\nduration = 0.05\n"
PUSHED = """[disturbance.q_i]
kind = "pulse"
amplitude = 200.0
start = 0.02
stop = 0.0202
[controller.current]
k_i = 152.0
[controller.inversion]
gamma = 1e6
"""


pytestmark = pytest.mark.usefixtures("elsewhere")


def answered(text, capsys):
    """Return the exit code and the text below the tables."""
    code = main(["check", write(text)])
    return code, capsys.readouterr().out.partition(advice.QUESTION)[2]


def advised(answer):
    """Tables and values that the answer advises, as TOML."""
    return re.findall(r"set \[(\S+)\] (\w+) above ([0-9.e-]+\d)", answer)


@pytest.mark.thorough
def test_following_the_advice_ends_in_a_held_rotor_and_conditions_that_hold(capsys):
    text = template("tracking")
    gamma, wanted = 1000.0, []
    for _ in range(3):
        shown = re.sub(r"gamma = \S+ ", f"gamma = {gamma} ", text)
        code, answer = answered(shown, capsys)
        if code == 0:
            break
        (where, name, value), *more = advised(answer)
        assert (where, name, more) == ("controller.inversion", "gamma", [])
        gamma = float(value)
        wanted.append(gamma)
        assert "`ambjax tune case.toml`" in answer
    # a tenth above Delta_1 of this reference, 6.23e4, rounded up to two digits
    assert wanted == [6.9e4]
    assert "Yes, all 5" in answer
    assert "The rotor is held." in answer


@pytest.mark.slow
def test_a_held_rotor_that_fails_a_condition_is_reported_as_held(capsys):
    code, answer = answered(SHORT + PUSHED, capsys)
    assert code == 1
    assert "1 of 5 does not" in answer
    assert "k_i = 152 must exceed 200 A/s" in answer
    assert advised(answer) == [("controller.current", "k_i", "220")]
    assert "held nevertheless" in answer
    assert "not necessary" in answer
    assert "is lost" not in answer
    # and with what is advised, a little above, the question is answered by yes
    assert answered((SHORT + PUSHED).replace("k_i = 152.0", "k_i = 220.1"), capsys)[0] == 0


def condition(gain, against, path="controller.inversion.gamma", ideal=False, at=0.1):
    over = f"Delta_1 along the {'reference' if ideal else 'run'}"
    return Condition("x", f"gamma > {over}", gain, against, at, "u", gain > against, "", path, over, ideal)


@pytest.mark.parametrize(
    ("gain", "along_run", "along_reference", "lost_at", "value"),
    [
        (1.0, condition(1.0, 1e9), 10.0, 0.1, "11"),
        # with less than twice what the reference requires, gamma itself may be what is missing
        (15.0, condition(15.0, 1e9), 10.0, 0.1, "20"),
        # of a rotor that is held, the larger of both counts
        (15.0, condition(15.0, 30.0), 10.0, math.inf, "33"),
        # the last tenth of a lost run is its fall
        (5.0, condition(1.0, 30.0, at=0.05), 4.0, 0.1, "33"),
    ],
)
def test_no_gain_is_advised_from_the_motion_of_a_falling_rotor(gain, along_run, along_reference, lost_at, value):
    report = Report([along_run, condition(gain, along_reference, ideal=True)], [], lost_at, "touched down", "")
    assert advised(advice.advice(report)[0]) == [("controller.inversion", "gamma", value)]


def test_a_gain_that_the_reference_does_not_require_is_not_advised():
    (words,) = advice.advice(Report([condition(100.0, 1e9), condition(100.0, 10.0, ideal=True)], [], 0.1, "", ""))
    assert "while the rotor falls" in words
    assert not advised(words)


@pytest.mark.parametrize("against", [math.nan, math.inf])
def test_a_value_that_is_not_finite_is_reported_without_advice(against):
    (words,) = advice.advice(Report([condition(1.0, against)], [], math.inf, "", ""))
    assert "not finite" in words
    assert not advised(words)


# Of each status: when a run ended, whether for the integrator, and what each command must say and return.
STATUSES = {"held": (math.inf, False), "lost": (0.01, False), "not decided": (0.01, True)}
WORDS = {
    "held": "The rotor is held.",
    "lost": "The rotor is lost at 0.01 s",
    "not decided": "The status of the rotor is not decided",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", STATUSES)
def test_every_command_reports_the_same_status_of_a_rotor(kind, capsys, monkeypatch):
    lost_at, stalled = STATUSES[kind]
    report = Report([condition(2.0, 1.0)], [], lost_at, "touched down", "", stalled)
    sampled = sampled_report.SampledReport([], [], lost_at, "touched down", stalled)
    assert report.holds == sampled.holds == (kind == "held")
    delays = sampled_report.Delays(None, None, None, 0.1)
    messages = {
        "check": "\n".join(advice.theorem_lines(report, "case.toml")),
        "on a processor": "\n".join(advice.processor_lines(sampled, delays, None)),
    }
    genuine = simulate._simulated

    def ended(*given):
        run = genuine(*given)
        code = STALLED if stalled else TOUCHED if kind == "lost" else 0
        metrics = run.metrics | {"lost": kind == "lost", "stalled": stalled, "lost_at_s": lost_at}
        trajectory = dataclasses.replace(run.trajectory, lost_at=lost_at, lost_code=code)
        return dataclasses.replace(run, trajectory=trajectory, metrics=metrics)

    monkeypatch.setattr(simulate, "_simulated", ended)
    assert main(["simulate", write(SHORT.replace("0.05", "0.002")), "--out", "out"]) == int(kind != "held")
    if kind != "held":  # whose metrics are the answer
        messages["simulate"] = capsys.readouterr().err
    for place, words in messages.items():
        assert [words.count(WORDS[other]) for other in WORDS] == [int(other == kind) for other in WORDS], place
