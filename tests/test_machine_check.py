"""`ambjax check` of a machine: its verdict without an equilibrium, and the test with more bending modes."""

import tomllib

import pytest

from ambjax.__main__ import main
from ambjax.cases.machine_case import read_machine
from ambjax.cases.template_text import template
from ambjax.commands import machine_check

FLEXIBLE = tomllib.loads(template("machine-flexible")) | {"sensitivity": {"speeds": [0.0]}}


def with_rotor(**changes):
    return read_machine(FLEXIBLE | {"rotor": FLEXIBLE["rotor"] | changes})


@pytest.mark.slow
def test_a_lost_rotor_without_an_equilibrium_has_a_verdict(tmp_path, capsys):
    """Each sensor is at an end of the shaft, behind a node of the first bending mode."""
    text = (
        template("machine-flexible")
        .replace("duration = 0.4", "duration = 0.05")
        .replace("settle = 0.2", "settle = 0.0")
    )
    for at, end in (("0.113", "0.0"), ("0.623", "0.702")):
        text = text.replace(f"\nat = {at}", f"\nat = {at}\nsensor_at = {end}", 1)
    (tmp_path / "far.toml").write_text(text)
    assert main(["check", str(tmp_path / "far.toml")]) == 1
    run, sensitivity, *_ = capsys.readouterr().out.splitlines()
    assert run.startswith("run: LOST (touched down")
    assert sensitivity.startswith("sensitivity: no zone and no margins: no equilibrium")


@pytest.mark.slow
def test_further_modes_are_damped_as_the_last_one_of_a_list():
    found, why = machine_check._spill_over(with_rotor(modes=2, damping=[0.003, 0.003]))
    assert found
    assert not why
    assert found == machine_check._spill_over(with_rotor(modes=2, damping=0.003))[0]
    assert found != machine_check._spill_over(with_rotor(modes=2, damping=[0.003, 0.2]))[0]


def test_the_check_says_why_there_is_no_test_with_more_modes():
    assert machine_check._spill_over(with_rotor(modes=20)) == ({}, "the rotor has 20 already, the largest number")
    rigid = read_machine(tomllib.loads(template("machine")))
    assert machine_check._spill_over(rigid) == ({}, "only a rotor of the kind shaft has further modes")
