"""Names that messages suggest, and warnings about numbers that are inconsistent."""

import json
import operator
import re
import warnings

import pytest
from texts import write

import ambjax
from ambjax.__main__ import main
from ambjax.cases.forces import forces
from ambjax.cases.plausibility import implausible
from ambjax.cases.reader import case_from
from ambjax.commands.reading import read_any_with_warnings


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"rotor": {"m": 1.0}}, "rotor.m = 1.0: unknown key. Did you mean 'plant.m'"),
        (
            {"controller": {"position": {"k_p": 1.0, "k_d": 1.0, "w_f": 1.0}}},
            "position.kind is left out, so the law is 'sliding-mode', .* These keys fit 'pid'",
        ),
        ({"controller": {"position": {"kind": "lqr"}}}, "kind = \"lqr\": .* Did you mean 'state-feedback'"),
        ({"plant": {"mass": 1.0}}, "plant.mass = 1.0: unknown key. Did you mean 'm'"),
        ({"plant": {"Bias_Current": 1.0}}, "Did you mean 'i_0'"),
        ({"plant": {"q": 1.0}}, "plant.q = 1.0: unknown key. Did you mean 'disturbance.q_z'"),
        ({"disturbance": {"q_z": {"kind": "sine", "freq": 1.0}}}, "Did you mean 'frequency'"),
        ({"plant": {"iron": {"B_sat": 1.2}}}, "Did you mean 'saturation'"),
        ({"plant": {"k_s": 1e5}}, "plant.k_s = 100000.0: unknown key. It follows from mu_0, n, A, s_0 and i_0"),
        ({"m": 2.0}, "m = 2.0: unknown key. Did you mean 'plant.m'"),
        ({"disturbance": {"q_z": {"kind": "step", "unit": "n", "amplitude": 1.0}}}, "Did you mean 'N'"),
        ({"sensor": {"runout": {"speed": 100.0}}}, "sensor.runout.harmonics is missing: it must be a list"),
        ({"plant": {"xyzzy": 1.0}}, "xyzzy = 1.0: unknown key. Keys allowed here"),
        ({"spread": {"plant": {"mass": {"percent": 10}}}}, "Did you mean 'plant.m'"),
        ({"plant": {"m": True}}, r"plant.m = true: it must be .* \(kg\)\.$"),
        ({"clock": {"sample_period": 1e4}}, "If it is a rate in Hz, give its inverse, 0.0001 s"),
    ],
)
def test_the_message_suggests_the_right_name(tables, said):
    with pytest.raises(ValueError, match=said):
        case_from(tables)


@pytest.mark.parametrize(
    ("former", "now"),
    [("Plant", "plants.Plant"), ("current", "laws.current"), ("RK4", "solvers.RK4"), ("Standard", "Metrics")],
)
def test_a_former_name_says_where_it_is_now(former, now):
    with pytest.raises(AttributeError, match=rf"'{former}'. Use ambjax.{now}.$"):
        getattr(ambjax, former)
    assert operator.attrgetter(now)(ambjax)


# A plausible bearing: 146 N/A, 364 N at the bias, a weight of 15.7 N, a pole of 675 1/s.
GOOD = {"m": 1.6, "k_z": 0.0, "mu_0": 1.2566e-6, "n": 208.0, "A": 2.68e-4, "s_0": 5e-4, "i_0": 2.5, "R": 1.0}


def doubts(plant=None, **tables):
    return implausible(case_from({"plant": GOOD | (plant or {}), "clock": {"duration": 0.1}, "run": {}} | tables))


def sine(frequency, amplitude=1.0):
    return {"disturbance": {"q_z": {"kind": "sine", "unit": "N", "amplitude": amplitude, "frequency": frequency}}}


def step(start):
    return {"disturbance": {"q_z": {"kind": "step", "unit": "N", "amplitude": 1.0, "start": start}}}


def runout(amplitude):
    return {"sensor": {"runout": {"speed": 100.0, "harmonics": [{"number": 2, "amplitude": amplitude}]}}}


UNBALANCE = {"kind": "unbalance", "unbalance": 1e-6, "speed": 4e5}
GRADED = {"kind": "unbalance-grade", "grade": 0.0025, "service_speed": 1e3, "speed": 1e3}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (" \n", "the file is empty"),
        ("[plant]\n", None),
        ("[plant]\ns_0 = 0.005\n", "[plant] omits numbers"),
        ("[sensor]\nstd = 1e-8\noffset = -1e-3\nstd_z_dot = 1e-6\n", "sensor.offset = -0.001 m is 20 % of the gap"),
        ("[plant]\n" + "\n".join(f"{key} = {value}" for key, value in (GOOD | {"s_0": 0.4}).items()), "millimetres"),
    ],
)
def test_python_and_the_commands_give_the_same_warnings(text, said, tmp_path, capsys):
    case = write(text, tmp_path / "case.toml")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ambjax.read_case(case)
    assert {one.filename for one in caught} <= {__file__}  # the line of the caller
    read_any_with_warnings(case)
    printed = capsys.readouterr().err.splitlines()
    assert [str(one.message) for one in caught] == printed
    assert any(said in line for line in printed) if said else not printed


@pytest.mark.parametrize(
    ("plant", "tables", "said"),
    [
        ({}, {}, None),
        ({"m": 5e5}, {}, "plant.m = 500000 kg: usual values are 0.001 to 100000 kg. Is it in grams?"),
        ({"m": 1600.0}, {}, "plant.m = 1600 kg: the rotor weighs .*, 43.1 times the largest force .* Is it in grams?"),
        ({"m": 300.0}, {"processor": {}, "actuator": {"i_max": 2.5}}, None),
        ({"i_0": 2500.0}, {}, "plant.i_0 = 2500 A: .* Is it in milliamperes?"),
        ({"i_0": 5.0}, {}, "the bias flux density .* is 1.31 T; iron saturates above about 1.2 T"),
        ({}, {"processor": {}, "actuator": {"i_max": 2500.0}}, "actuator.i_max = 2500 A is 1000 times plant.i_0. Is"),
        ({"iron": {"saturation": 0.5}}, {}, "saturation = 0.5 T is less than the bias flux density .* = 0.653 T"),
        ({}, sine(50.0, 350.0), "weight and loads reach 365.7 N, but the magnets pull with at most 364.2 N"),
        ({}, sine(50.0, 345.0), None),
        ({}, sine(6000.0), "disturbance.q_f: frequency gives 6000 Hz, not below half the sampling rate, 5000 Hz"),
        ({}, {"disturbance": {"q_z": UNBALANCE}}, "disturbance.q_f: speed gives 6667 Hz"),
        ({}, {"processor": {}, "clock": {"duration": 0.1, "sample_period": 1e-3}}, "has only 1.5 samples. Give"),
        ({}, {"processor": {}, "sensor": {"bandwidth": 50.0}}, "sensor.bandwidth = 50 Hz is less than twice the"),
        ({}, {"rotor": {"speed": 6e4}, "controller": {"notch": {"rate": 700.0}}}, "exceeds .* A notch must converge"),
        ({}, {"processor": {}, "sensor": {"bits": 8, "std": 1e-7}}, "a step of 3.91e-06 m is 39.1 times the noise"),
        ({}, step(0.09) | {"processor": {"delay": 0.0}, "sensor": {"bits": 14, "std": 1e-7}}, None),
        ({}, {"processor": {"delay": 5e-5}}, "processor.delay = 5e-05 samples is close to 0. Is it in seconds"),
        ({}, runout(2.3e-4), "the harmonics reach 0.00023 m, 51.1 % of run.clearance"),
        ({"iron": {"saturation": 1.4}}, runout(2e-6) | {"disturbance": {"q_z": GRADED | {"grade": 2.5}}}, None),
        ({}, step(0.1), "disturbance.q_f: start = 0.1 s, but the run ends at clock.duration = 0.1 s"),
        ({}, {"disturbance": {"q_z": [GRADED, {"kind": "constant"}]}}, "disturbance.q_z: grade = 0.0025 mm/s: ISO 2"),
        ({}, {"rotor": {"speed": 1.5e5}}, "rotor.speed: 2 times the speed is 5000 Hz, not below half the"),
        ({}, {"rotor": {"speed": 60.0}}, "rotor.speed: the rotor makes 0.0.* revolutions after run.settle"),
        ({}, sine(4000.0) | {"rotor": {"speed": 6e4}, "processor": {}, "sensor": {"dropouts": {"at": 0.09}}}, None),
        ({}, {"processor": {}, "sensor": {"bits": 14, "range_z": 1e-9}}, "sensor.range_z = 1e-09: the converter reads"),
        ({}, {"processor": {}, "sensor": {"bits": 14, "range_i": 0.1}}, "converter reads 4 % of the bias current"),
        ({}, {"actuator": {"u_max": 48.0, "dead_band": 50.0}, "processor": {}}, "dead_band = 50 V is not below"),
        ({}, {"processor": {}, "sensor": {"outliers": {"size": 1e-4}}}, "sensor.outliers: no fault occurs"),
        ({}, {"processor": {}, "sensor": {"dropouts": {"at": 0.1}}}, "sensor.dropouts: at = 0.1 s, but the run ends"),
    ],
)
def test_inconsistent_numbers_cause_a_warning(plant, tables, said):
    found = doubts(plant, **tables)
    assert any(re.search(said, line) for line in found) if said else not found, found


@pytest.mark.parametrize(("end", "doubted"), [(9.9, False), (10.1, True)])
def test_a_file_in_milliseconds_causes_a_warning(tmp_path, end, doubted):
    """The run lasts 0.1 s, and the file is 100 times as long."""
    load = {"kind": "table", "unit": "N", "file": str(write(f"0,1\n{end},2\n", tmp_path / "force.csv"))}
    said = f"disturbance.q_f: the file lasts {end:g} s, the run 0.1 s. Are its times in milliseconds?"
    assert (said in doubts(disturbance={"q_z": load})) == doubted


def test_the_printed_forces_agree_with_the_formulas():
    case = case_from({"plant": GOOD, "clock": {"duration": 0.1}} | sine(50.0, 3.0))
    k_i = 1.2566e-6 * 208**2 * 2.68e-4 * 2.5 / 5e-4**2
    assert forces(case) == pytest.approx((k_i * 2.5, 1.6 * 9.81, 3.0))
    load = {"disturbance": {"q_z": [{"kind": "constant", "value": 2.0}], "base": {"kind": "constant", "value": -1.0}}}
    assert forces(case_from({"plant": GOOD} | load)).load == pytest.approx(1.6 * 3.0)


@pytest.mark.slow
def test_check_fails_if_the_magnets_cannot_carry_the_rotor(capsys, elsewhere):
    heavy = "\n".join(f"{name} = {value}" for name, value in (GOOD | {"m": 40.0}).items())
    falling = write(f"[plant]\n{heavy}\n[processor]\n[clock]\nduration = 0.02\n")
    assert main(["simulate", falling, "--out", "lost"]) == 1
    assert "No gains hold it: the magnets cannot carry the rotor: their largest" in capsys.readouterr().err
    case = write(f"[plant]\n{heavy}\n[clock]\nduration = 0.001\n")
    assert main(["check", case]) == 1
    assert "their largest force is 364.2 N, below its weight of 392.4 N" in capsys.readouterr().out
    assert main(["check", case, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["holds"] is False
