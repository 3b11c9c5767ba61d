"""Every observer with every position law is linearised, in continuous time and with both kinds of steps.

The verdict of the linear loop agrees with the nonlinear simulation of a small deviation: it decays if the loop is
stable, and grows if not.
"""

import dataclasses
import importlib.resources
import json

import jax
import numpy as np
import pytest
from javascript import run_rows, with_node
from profiles import THOROUGH

from ambjax import Cascade, Clock, Scenario, rollout
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.reader import case_from
from ambjax.codegen.javascript.script import PRELUDE
from ambjax.control import current, inversion
from ambjax.control.base import default_law
from ambjax.control.processor import Processor
from ambjax.control.sampling import Sampling
from ambjax.linear import StateSpace, linearise
from ambjax.numerics.records import canonical
from ambjax.page.loop_functions import linear_script, loop_parameters
from ambjax.plants import Plant
from ambjax.world.scenario import Initial

RIG = Plant(1.64, 0.0, 1.2566e-6, 208.0, 2.68e-4, 5e-4, 2.5, 1.0, 0.0)
T = 5e-5
MODES = {"continuous": None, "implicit": Processor(1.0), "explicit": Processor(1.0, implicit=False)}
# The deviation is inside the boundary layers of all smoothed signs, of which the narrowest is 5e-10 m wide.
SMALL = 1e-12
CLOCK = Clock(samples=2000, sample_period=T)


def cascade_of(mode, watching, moving):
    processor = MODES[mode]
    sampling = None if processor is None else Sampling(T, 0.0, processor.implicit)
    kinds = watching, moving, inversion.Linearised, current.ProportionalIntegral
    laws = (default_law(kind, RIG, sampling) for kind in kinds)
    return Cascade(*laws, model=RIG, processor=processor)


FAST = {("implicit", "direct", "pid")}
ALL = [
    pytest.param(
        mode,
        watching,
        moving,
        id=f"{mode}-{watching}-{moving}",
        marks=() if (mode, watching, moving) in FAST
        else pytest.mark.slow if watching == "kalman" and mode != "implicit" and moving == "sliding-mode"
        else pytest.mark.thorough,
    )
    for mode in MODES for watching in KINDS["observer"] for moving in KINDS["position"]
]  # fmt: skip


@pytest.fixture
def released():
    """Release the programs of a thorough test: the operating system limits the memory maps of one process."""
    yield
    if THOROUGH:
        jax.clear_caches()


@pytest.mark.usefixtures("released")
@pytest.mark.parametrize(("mode", "watching", "moving"), ALL)
def test_a_small_deviation_decays_if_and_only_if_the_linear_loop_is_stable(mode, watching, moving):
    cascade = cascade_of(mode, KINDS["observer"][watching], KINDS["position"][moving])
    scenario = Scenario(plant=RIG, initial=Initial(SMALL))
    system = linearise(cascade, scenario, CLOCK)
    assert not system.idle().any()
    poles = system.poles()
    growth = np.max(np.real(poles) if system.period is None else np.log(np.abs(poles) + 1e-300) / T)
    assert system.stable == (growth < 0)
    size = np.abs(np.asarray(rollout(cascade, scenario, CLOCK).trajectory.rows.z)) / SMALL
    if abs(growth) * CLOCK.duration > 3:  # otherwise the deviation neither decays nor grows during the run
        # a deviation that grows may end in a small limit cycle of the signs
        decays = np.max(size[-200:]) < np.max(size[:200]) < 1e6
        assert decays if system.stable else np.max(size) > 10, (growth, np.max(size), np.max(size[-200:]))


def test_a_pole_on_the_border_is_stable_only_up_to_rounding_errors():
    """In units of the fastest pole: 1e-13 is a rounding error, 1e-11 is a growth."""
    for growth, stable in ((1e-13, True), (1e-11, False)):
        parts = np.zeros((2, 3)), np.zeros((4, 2)), np.zeros((4, 3)), np.ones(2)
        assert StateSpace(np.diag([-1.0, growth]), *parts).stable is stable
        assert StateSpace(np.diag([0.1, 1 + growth]), *parts, period=np.asarray(1.0)).stable is stable


def test_the_response_of_many_states_is_that_of_the_definition():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(50, 50)) / 10
    A[:5] = 0.0  # as commands kept by a processor
    B, C, D = rng.normal(size=(50, 2)), rng.normal(size=(3, 50)), rng.normal(size=(3, 2))
    system, f = StateSpace(A, B, C, D, np.geomspace(0.1, 10, 50), np.asarray(1e-4)), np.geomspace(1.0, 4500.0, 60)
    each = [C @ np.linalg.solve(np.exp(2e-4j * np.pi * one) * np.eye(50) - A, B) + D for one in f]
    np.testing.assert_allclose(system.response(f), each, rtol=1e-10, atol=1e-12)


@with_node
@pytest.mark.slow
def test_the_page_linearises_a_loop_with_a_state_that_never_changes(tmp_path):
    """Explicit steps do not use the memory of the Kalman filter. The page's JavaScript runs in node."""
    laws = {"observer": {"kind": "kalman"}, "inversion": {"kind": "linearised"}, "current": {"kind": "pi"}}
    plant = {field.name: getattr(RIG, field.name) for field in dataclasses.fields(RIG) if field.name != "iron"}
    given = {"plant": plant, "controller": laws, "processor": {"delay": 1.0, "discretisation": "explicit"}}
    case = case_from(given | {"clock": {"sample_period": T, "duration": 0.01}})
    (source, facts), asset = linear_script(case), importlib.resources.files("ambjax.page") / "assets" / "sensitivity.js"
    run = f"""const facts = {json.dumps(facts)};
    function run(P) {{ const S = sensitivity(P, facts, {T}, 1.0); return [S.peak, S.frequency, Number(S.stable)]; }}"""
    numbers = np.array([jax.tree.leaves(canonical(loop_parameters(case, any_delay=True)))], float)
    peak, f, stable = run_rows("\n".join([PRELUDE, source, asset.read_text(encoding="utf-8"), run]), numbers, tmp_path)[
        0
    ]
    system = linearise(case.cascade, case.scenario, case.clock)
    # both equilibria are exact to 1e-9 of the sizes of the states
    assert peak == pytest.approx(np.abs(system.sensitivity(np.array([f])))[0], rel=1e-7)
    assert stable == system.stable
