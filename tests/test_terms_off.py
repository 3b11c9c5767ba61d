"""Gains of 0, which switch a term of a law off, the low-pass that is left out, and laws that need no velocity."""

import dataclasses
import tomllib

import numpy as np
import pytest
from test_structures import RIG

from ambjax import Cascade, Clock, Scenario
from ambjax.cases.reader import case_from
from ambjax.control import current, inversion, position
from ambjax.control.base import default_law
from ambjax.control.processor import Processor
from ambjax.control.sampling import Sampling
from ambjax.linear import analyse, linearise
from ambjax.linear.equilibrium import equilibrium, ideal
from ambjax.simulation.system import reads_velocity

T = 5e-5
# A bearing with a current amplifier: chain without observer, PD unless k_int is given.
BEARING = tomllib.loads("""
controller.position = { kind = "chain", k_p = 1.2e4, k_int = 0.0, k_d = 25.0, w_f = 20000.0 }
controller.inversion = { kind = "linearised" }
actuator = { mode = "current", bandwidth = 1500.0, u_max = 100.0, i_max = 2.5 }
processor = { delay = 1.0, predict = false }
sensor = { velocity = false }
clock = { duration = 0.1, sample_period = 1e-4 }
plant = { kind = "two-coil", m = 3.27, k_z = 0, mu_0 = 1.2566e-6, n = 208, A = 2.68e-4, s_0 = 7.8e-4, i_0 = 2.5, R = 1 }
""")


def tables(position=(), **changes):
    """The tables of the case with other entries, and another position law if its kind is given."""
    given = {name: {**table, **changes.get(name, {})} for name, table in BEARING.items()}
    usual = {} if "kind" in position else BEARING["controller"]["position"]
    given["controller"]["position"] = {**usual, **dict(position)}
    return given


def bearing(**changes):
    return case_from(tables(**changes))


def analysis(case):
    return analyse(linearise(case.cascade, case.scenario, case.clock), case.scenario.plant.m, T, case.zones)


def zeros(law):
    return [field.name for field in dataclasses.fields(law) if field.metadata.get("at_least") == 0.0
            and "steepness" in field.metadata]  # fmt: skip


WITH_ZEROS = {
    position.PID: ["k_int", "k_aw"],
    position.StateFeedback: ["k_int", "k_aw"],
    position.FilterChain: ["k_int", "k_d", "k_aw", "depth_1", "depth_2"],
    position.IntegralSlidingMode: ["c_int"],
    position.SuperTwisting: ["k_2"],
    current.ProportionalIntegral: ["k_int", "k_aw"],
}
EACH = [(kind, name) for kind, names in WITH_ZEROS.items() for name in names]


@pytest.mark.parametrize("kind", WITH_ZEROS)
def test_0_is_allowed_exactly_where_it_switches_a_term_off(kind):
    law = default_law(kind, RIG)
    assert zeros(law) == WITH_ZEROS[kind]
    dataclasses.replace(law, **dict.fromkeys(zeros(law), 0.0))
    with pytest.raises(ValueError, match=r"p = 0: it must be|k_p = 0: it must be|c = 0: it must be"):
        dataclasses.replace(law, **{"k_p" if hasattr(law, "k_p") else "c": 0.0})


LINEARISED = [
    pytest.param(
        kind, name, processor,
        id=f"{kind.__name__}-{name}-{'sampled' if processor else 'continuous'}",
        marks=pytest.mark.slow if kind is position.PID or (processor and name in ("k_int", "c_int", "k_2"))
        else pytest.mark.thorough,
    )
    for kind, name in EACH for processor in (None, Processor(1.0))
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name", "processor"), LINEARISED)
def test_a_loop_without_a_term_is_the_limit_of_loops_with_a_small_one(kind, name, processor):
    """|S| at 20 frequencies: with 0, and with a millionth of the default gain."""
    sampling = None if processor is None else Sampling(T, 0.0, True)
    drive = {"inversion": inversion.Linearised(), "current": default_law(current.ProportionalIntegral, RIG, sampling)}
    stage = "current" if kind is current.ProportionalIntegral else "position"
    laws = {"position": default_law(position.PID, RIG, sampling)} | drive
    laws[stage] = default_law(kind, RIG, sampling)
    if name == "k_d":  # a lead-lag gives the phase lead
        w = float(RIG.pole)
        laws[stage] = dataclasses.replace(laws[stage], w_z=w, w_p=20 * w, k_int=0.0)
    if name == "k_int":  # the anti-windup of a small integral acts on the lag of the current, by 1e-3
        laws[stage] = dataclasses.replace(laws[stage], k_aw=0.0)
    found = []
    for share in (0.0, 1e-6):
        law = dataclasses.replace(laws[stage], **{name: share * getattr(laws[stage], name)})
        cascade = Cascade(**(laws | {stage: law}), model=RIG, processor=processor)
        system = linearise(cascade, Scenario(plant=RIG), Clock(samples=10, sample_period=T))
        found.append(np.abs(system.sensitivity(np.geomspace(1.0, 5000.0, 20))))
    # at 1 Hz, the lowest frequency, a millionth of an integral gain still changes the response
    assert found[0] == pytest.approx(found[1], rel=1e-3)


def test_a_pd_controller_has_the_static_stiffness_of_the_textbook():
    """k_i k_p - k_s at the current i that carries the rotor: there, k_s is larger by the factor 1 + (i/i_0)^2."""
    case = bearing()
    plant, found = case.scenario.plant, analysis(case)
    kappa = plant.mu_0 * plant.n**2 * plant.A
    k_i, k_s = kappa * plant.i_0 / plant.s_0**2, kappa * plant.i_0**2 / plant.s_0**3
    i = plant.m * plant.g / k_i
    # 1e-5: the response at 1e-6 Hz stands for that at 0
    assert found.stiffness == pytest.approx(1.2e4 * k_i - k_s * (1 + (i / plant.i_0) ** 2), rel=1e-5)
    assert found.stable
    tiny = analysis(bearing(position={"k_int": 1e-20}))
    assert tiny.stable
    # the anti-windup of the tiny integral, at 4.8 1/s, changes |S| by less than a thousandth
    assert tiny.S.height == pytest.approx(found.S.height, rel=1e-3)
    assert tiny.noise == pytest.approx(found.noise, rel=1e-3)


@pytest.mark.parametrize("processor", [None, Processor(0.0)], ids=["continuous", "sampled"])
def test_an_integral_without_gain_does_not_remove_the_offset_of_a_heavier_rotor(processor):
    """The rotor is 10 % heavier than the model: k_p e = -0.1 g, with springs k_z = 0 and an exact inversion."""
    law = dataclasses.replace(default_law(position.PID, RIG), k_int=0.0)
    cascade = Cascade(position=law, inversion=inversion.ClosedForm(), model=RIG, processor=processor)
    cascade = cascade if processor is None else cascade.on_processor()
    heavy = ideal(Scenario(plant=dataclasses.replace(RIG, m=1.1 * RIG.m)))
    point, found, _ = equilibrium(cascade, heavy, T, 0.0)
    assert found
    assert abs(float(point.control.position.integral)) < 1e-12  # of 0.2 m/s^2: rounding
    # 1e-6: the equilibrium is exact to 1e-9 of the size of z, a fiftieth of the gap
    assert float(point.plant.z) == pytest.approx(-0.1 * RIG.g / law.k_p, rel=1e-6)


REFUSED = r"sensor\.velocity = false: the velocity is not measured.*predict = false"


@pytest.mark.parametrize(
    ("changes", "reads"),
    [
        ({}, False),
        ({"processor": {"predict": True}}, True),
        ({"controller": {"observer": {"kind": "difference"}}, "processor": {"predict": True}}, False),
        ({"position": {"kind": "state-feedback", "k_int": 1.0}}, True),
    ],
    ids=["chain", "prediction", "difference", "state feedback"],
)
def test_a_measured_velocity_is_needed_only_by_laws_that_use_it(changes, reads):
    given = tables(**changes)
    cascade = case_from({**given, "sensor": {}}).cascade
    assert reads_velocity(cascade, T) == reads
    if reads:
        with pytest.raises(ValueError, match=REFUSED):
            case_from(given)
    else:
        case_from(given)
