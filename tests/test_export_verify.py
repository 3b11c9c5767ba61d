"""Verification of the exported C: each check fails for a program with a matching fault, none for a correct one."""

import dataclasses
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import examples
from test_export import PERIOD, compiled, drafts, failed, hard

from ambjax import RK4, Clock, Scenario, Sensor, Sine
from ambjax.cases.reader import read_case
from ambjax.codegen import closed_loop
from ambjax.codegen.c99 import machine
from ambjax.codegen.c99.machine import Compiled
from ambjax.codegen.interface import INPUTS
from ambjax.codegen.numbering import UNREAD
from ambjax.codegen.points import evaluated
from ambjax.codegen.trace import arguments
from ambjax.codegen.twins import LEAST, PARTED, SIGNALS, Horizon, LoopCase, Twin, _count, farthest
from ambjax.codegen.verify import Check, _looped, _stepped, checks_page, checks_verdict, holds, verify
from ambjax.control import current, inversion, observer, position
from ambjax.control.guard import guarded
from ambjax.control.processor import Processor
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled
from ambjax.world.faults import Dropouts, Outliers

INF = np.inf
# A loop that amplifies rounding by a factor of 10 in about 40 samples: signs without a layer, a converter, an estimate.
RESTLESS = hard(
    observer=observer.Kalman(393.65),
    position=position.SlidingMode(1511.5, 2.75, INF),
    inversion=inversion.Adaptive(2.69e7, INF),
    current=current.SlidingMode(430.2, INF),
)
WORLD = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(1e-6, 0.0, 1e-4, velocity=False, bits=14), u_max=200.0)
# One reading beyond the gap, and readings that do not come for 1 ms.
FAULTS = {"outliers": Outliers(at=4e-3, size=9.9e-3), "dropouts": Dropouts(at=8e-3, duration=1e-3, value="nan")}


@pytest.fixture(scope="module")
def made():
    """The paper's laws in double precision, with one set-valued sign; the other signs are smoothed."""
    cascade = hard(position=position.SlidingMode(1440.0, 2.3), processor=Processor(1.0))
    return drafts(cascade, ["double"], 4000)["double"]


def library(source, one, folder, name):
    """Compile the exported C with this text as a library."""
    (folder / name).mkdir()
    (folder / name / "amb.h").write_text(one.files["amb.h"])
    (folder / name / "amb.c").write_text(source)
    said = machine.build([folder / name / "amb.c"], folder / name / "amb.so", *machine.SHARED, "-Wno-error")
    assert not said
    return Compiled(folder / name / "amb.so", one.trace, "amb")


def frozen(one, names):
    """The source with these parameters written in as constants."""
    source = one.files["amb.c"]
    for x in (x for x in one.trace.parameters if x.name in names):
        source = re.sub(rf"params->{re.escape(x.name)}\b", f"({x.value!r})", source)
    return source


# --- other parameters ---


@pytest.mark.slow
@compiled
def test_gains_or_limits_written_as_constants_in_the_c_are_found(made, tmp_path):
    names = {x.name for x in made.trace.parameters}
    limits = {x for x in names if x.startswith("limits.")}
    model = {x for x in names if x.startswith("model.")}
    checks = {}
    for what, fixed in {"none": set(), "gains": names - limits - model, "model": model, "limits": limits}.items():
        controller = library(frozen(made, fixed), made, tmp_path, what)
        checks[what] = [x for name in made.steps for x in _stepped(name, made, "double", controller)]
    assert not failed(checks.pop("none"))
    for what, found in checks.items():  # with the case's parameters nothing is wrong
        assert {x.name.partition(",")[0] for x in failed(found)} == {"parameters"}, what


@pytest.mark.slow
def test_every_parameter_changes_the_result_at_some_point(made):
    """If the C contained this parameter as a constant, a number or a bit would differ at some point."""
    at, should = made.steps["parameters"]
    x = np.concatenate([at.parameters, at.state, at.inputs])
    trace = made.trace
    roots = [value.node for value in trace.roots() if hasattr(value, "node")]
    own = evaluated(trace, x, at.started)
    read = [(k, p) for k, p in enumerate(trace.parameters) if p.allowed != UNREAD]
    assert len(read) > 20
    for k, p in read:
        y = x.copy()
        y[k] = p.value
        other = evaluated(trace, y, at.started)
        assert any(not np.array_equal(own[n], other[n], equal_nan=True) for n in roots), p.name
        alone = np.delete(at.parameters, k, 0) == np.delete([x.value for x in trace.parameters], k)[:, None]
        for end in p.ends:
            assert np.sum(np.isclose(at.parameters[k], end, rtol=0, equal_nan=True) & alone.all(0)) > 10, (p.name, end)
    refused = should.bits & 32 > 0
    for name, wrong in {"processor.delay": 1.5, "position.p": INF}.items():
        (k,) = (k for k, p in read if p.name == name)
        assert refused[at.parameters[k] == wrong].all()
        assert not refused[at.parameters[k] == trace.parameters[k].value].all()


@pytest.mark.slow
def test_a_steepness_of_inf_is_refused_as_the_header_states(made):
    controller = made.trace.block
    parameters, memory, inputs, period = arguments(controller)
    step = jax.jit(lambda p: controller.step(p, memory, inputs, period, frozenset(INPUTS)))

    def with_p(p):
        law = dataclasses.replace(parameters.controller.position, p=jnp.asarray(p))
        return parameters._replace(controller=dataclasses.replace(parameters.controller, position=law))

    for p, refused in {25.0: False, 1e12: False, INF: True, np.nan: True}.items():
        kept, _, status = step(with_p(p))
        assert (bool(status.invalid), bool(status.failed), bool(kept.started)) == (refused, False, not refused), p
    allowed = "finite: set p = inf in the case and export again"
    assert f"amb_real p; /* [s/m, above 1e-30 and at most 1e+30, {allowed}] " in made.files["amb.h"]
    assert "params->position.p: finite, else every step is invalid." in made.files["amb.h"]


# --- the horizon ---


@pytest.mark.slow
def test_a_twin_without_a_change_equals_the_loop_and_a_changed_twin_differs_in_every_state():
    sensor = Sensor(1e-6, 0.0, 1e-4, velocity=False, bandwidth=2e3)  # a converter would hide a unit
    scenario = dataclasses.replace(WORLD, sensor=sensor, u_max=INF)
    system = Sampled(ClosedLoop(guarded(RESTLESS.on_processor(), scenario, PERIOD), scenario), PERIOD, 0).realised()

    @jax.jit
    def jumped(seed, unit, n):
        return Twin(system.loop, PERIOD, 0, seed, unit).jump(n * PERIOD, state, errors)

    errors, state = system.sensor_errors(3), system.start()
    plain = jax.jit(system.jump)(3 * PERIOD, state, errors)
    still, *moved = jumped(1.0, 0.0, 3), *(jumped(seed, 1e-12, 3) for seed in (1.0, 2.0))
    leaves = jax.tree.leaves
    np.testing.assert_array_equal(leaves(still), leaves(plain))
    # flags and counts are no states
    assert all((one.finite, one.watch.left) == (plain.finite, plain.watch.left) for one in moved)
    before, *after = (np.array(leaves(x._replace(finite=(), watch=x.watch.expected))) for x in (plain, *moved))
    # with one seed the sign of a unit may leave i_ref at exactly 0
    np.testing.assert_array_equal((np.array(after) == before).all(axis=0), False)
    assert np.all(np.abs(after - before) < 1e-4)  # the laws amplify a unit of 1e-12: a force of 2500 A^2/m^2 in z
    # every seed and every sample draws signs of its own
    for given in ([(seed, 1e-12, 3) for seed in range(8)], [(1.0, 1e-12, n) for n in range(8)]):
        assert len({tuple(map(float, leaves(jumped(*x).plant))) for x in given}) > 2


def test_the_horizon_ends_before_the_first_signal_diverges():
    grown = {"z": np.array([0, 1e-3, 2e-2, 1.0]), "u": np.array([0, 0, 1e-3, 1e-3])}
    assert _count(grown, {"z": 1.0, "u": 1.0}, 4) == 2
    assert _count(grown, {"z": 1e3, "u": 1.0}, 4) == 4
    assert _count(grown, {"z": 1e3, "u": 0.02}, 4) == 2
    assert _count(grown, {"z": 1e3, "u": 1.0}, 3) == 3  # the rotor is lost
    assert _count(grown, {"z": 0.0, "u": 1.0}, 4) == 1  # an error of 0 has parted with the first difference
    assert _count({"z": np.array([0, np.nan]), "u": np.zeros(2)}, {"z": 1.0, "u": 1.0}, 2) == 1
    loops = np.array([[0.0, 2.0, 1.0, 0.0], [0.0, -3.0, 0.0, 5.0]])
    np.testing.assert_array_equal(farthest(loops, np.zeros(4)), [0, 3, 3, 5])


def horizon(samples, of=100):
    zeros = dict.fromkeys(SIGNALS, np.zeros(of))
    return Horizon(zeros, {name: np.linspace(0, 1e-6, of) for name in SIGNALS}, dict.fromkeys(SIGNALS, 1.0), samples)


def test_a_loop_is_compared_with_its_twins_within_the_horizon_only():
    one, twins = horizon(50), np.linspace(0, 1e-6, 100)
    assert closed_loop.times_of(0.5 * twins, one) == pytest.approx(0.5, abs=1e-12)
    assert closed_loop.times_of(np.where(np.arange(100) < 50, twins, 1.0), one) == pytest.approx(1, abs=1e-12)
    assert closed_loop.times_of(np.where(np.arange(100) < 49, twins, 1.0), one) > 1e5
    assert closed_loop.times_of(np.full(100, 1e-30), one) == INF  # off where no twin is
    assert closed_loop.times_of(np.full(100, np.nan), one) == INF
    assert np.isnan(closed_loop.times_of(twins, horizon(LEAST - 1)))


def test_a_short_horizon_is_not_decisive():
    good, bad = Check("a", "double", "", "", True), Check("b", "double", "", "", False)
    row = _looped("float", closed_loop.LoopComparison(horizon(LEAST - 1), np.nan))
    assert (row.ok, row.verdict) == (None, "not decisive")
    assert row.found == f"twins of JAX's loop differ too much after {LEAST - 1} of 100 samples"
    assert holds([good, row])
    assert checks_verdict([good, row]) == "No check fails; 1 of 2 are not decisive."
    assert "| not decisive |" in checks_page([good, row], "case", "")
    assert not holds([good, row, bad])
    assert checks_verdict([good, row, bad]) == "Some checks FAIL."
    assert checks_verdict([good]) == "All checks hold."
    row = _looped("float", closed_loop.LoopComparison(horizon(LEAST), closed_loop.TIMES))
    assert (row.ok, row.verdict) == (True, "holds")
    assert _looped("float", closed_loop.LoopComparison(horizon(LEAST), 1.001 * closed_loop.TIMES)).verdict == "FAILS"


@pytest.mark.thorough
@compiled
def test_a_loop_that_amplifies_rounding_is_compared_up_to_its_horizon(tmp_path):
    """Correct C passes although rounding grows a thousandfold after the horizon, and C with another gain fails.

    The case has faults, so that the guard acts in the loop.
    """
    world = dataclasses.replace(WORLD, sensor=dataclasses.replace(WORLD.sensor, **FAULTS))
    one = drafts(RESTLESS, ["double"], 100, scenario=world)["double"]
    case = LoopCase(RESTLESS, world, Clock(600, PERIOD, RK4(1)), 0.0)
    sources = {"correct": one.files["amb.c"]}
    sources["another"] = sources["correct"].replace("params->position.c", "((1 + 1e-9) * params->position.c)")
    rows = {}
    for name, source in sources.items():
        controller, results = library(source, one, tmp_path, name), []
        controller.step = lambda step=controller.step, results=results: results.append(step()) or results[-1]
        rows[name] = closed_loop.compare_loops(case, {"double": controller})["double"]
        assert sum(bits & 2 > 0 for bits in results) == 11
    found = rows["correct"].horizon
    assert LEAST < found.samples < 600
    assert found.parted["z"][-1] > 1e3 * PARTED * found.parted["z"][found.samples // 2]
    assert rows["correct"].times <= closed_loop.TIMES
    assert rows["another"].times > 10 * closed_loop.TIMES


# --- slow: a mutant for each row, and many correct programs ---

MUTANTS = {
    "a sum is a difference": (r"(v\d+) \+ (v\d+)", r"\1 - \2"),
    "a product is a sum": (r"(v\d+) \* (v\d+)", r"\1 + \2"),
    "a choice is turned": (r"(= v\d+ \? )(v\d+) : (v\d+)", r"\1\3 : \2"),
    "a comparison is turned": (r"(v\d+) > (v\d+)", r"\1 < \2"),
    "a comparison takes the border in": (r"<= params->processor\.guard\.z\b", "< params->processor.guard.z"),
    "a factor of two is three": (r"= 2\.0f? \*", "= 3.0 *"),
    "a state is not kept": (r"state->observer\.z_hat = (v\d+)", r"(void)\1"),
    "the voltage is not kept": (r"state->last\.u = (v\d+)", r"(void)\1"),
    "a bit is not set": (r"status \|= amb_REFUSED;", ""),
    "a start is forgotten": (r"state->started = (v\d+) \? 1u : 0u", r"state->started = state->started, (void)\1"),
    "a gain is another": (r"params->position\.k\b", "params->position.c"),
    "the period is another": (r"amb_SAMPLE_PERIOD \*", "2 * amb_SAMPLE_PERIOD *"),
    "a magnitude has a sign": (r"fabsf?\((v\d+)\)", r"(\1)"),
    "a number of the model is another": (r"params->model\.s_0\b", "params->model.i_0"),
    "an output is another": (r"output->i_ref = v\d+", "output->i_ref = output->u"),
    "the last digit of a constant": (r"= 4\.0f? \*", "= 4.0001 *"),
}


@compiled
@pytest.mark.thorough
def test_every_mutant_is_found():
    made = drafts(hard(processor=Processor(1.0, predict=False)), ["double"])
    for says, (old, new) in MUTANTS.items():
        one = made["double"]
        source, count = re.subn(old, new, one.files["amb.c"], count=1)
        assert count == 1, says
        mutant = dataclasses.replace(one, files={**one.files, "amb.c": source})
        assert failed(verify({"double": mutant}, None)), says


# For each row of the table a change for which it, of all rows of its kind, fails: the file, and what is replaced.
STEP, COUNTS = "    uint32_t status = 0u;", "    int failed = 0, faults = 0;"
ROWS = {
    "compiles": ("amb.c", STEP, f"{STEP}\n    int unused;"),
    "compiles, sanitized": ("amb.c", STEP, f"#ifdef __SANITIZE_ADDRESS__\n#error no\n#endif\n{STEP}"),
    "test program": ("amb_test.c", "return failed > 0 || faults > 0;", "return 1;"),
    "test program, sanitized": (
        "amb_test.c",
        COUNTS,
        f"{COUNTS}\n    volatile int m = {2**31 - 1};\n    faults += m + 1 > 0;",
    ),
    "library": (
        "amb.c",
        STEP,
        f"#ifdef __PIC__\n#if __PIC__ == 2 && !defined(__PIE__)\n#error no\n#endif\n#endif\n{STEP}",
    ),
    "one step, numbers": ("amb.c", "output->v_star = ", "output->v_star = 1.000001 * "),
    "one step, status": ("amb.c", "status |= amb_SINGULAR;", "status |= 0u;"),
    "parameters, numbers": ("amb.c", "params->position.c", "1440.0"),
    "parameters, status": ("amb.c", "params->limits.near", "0.1"),
    "closed loop, dz": ("amb.c", "params->position.c", "((1 + 1e-9) * params->position.c)"),
}


@compiled
@pytest.mark.slow
def test_every_check_fails_for_a_program_with_its_fault():
    scenario = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(1e-6, 1e-4, 1e-4), u_max=200.0)
    made = drafts(hard(), ["double"], 2000, scenario=scenario)["double"]
    case = LoopCase(hard(), scenario, Clock(200, PERIOD, RK4(1)), 0.005)
    rows = verify({"double": made}, case)
    assert [x.name for x in rows if not x.ok] == []
    assert {x.name for x in rows} == set(ROWS)
    for name, (file, old, new) in ROWS.items():
        assert old in made.files[file], name
        mutant = dataclasses.replace(made, files={**made.files, file: made.files[file].replace(old, new)})
        found = {x.name: x.ok for x in verify({"double": mutant}, case)}
        assert found[name] is False, (name, found)


TASKS = pathlib.Path(__file__).parents[1] / "benchmarks" / "tasks" / "sampled"
# Tuned gains of benchmarks/README.md: signs without a layer, with which rounding grows.
TUNED = {
    "A10-signs": {"c": 1440.0, "k": 2.307, "gamma": 7.971e5, "k_i": 870.6},
    "C10-signs": {"c": 2000.0, "k": 2.233, "gamma": 3.364e6, "k_i": 1205.0},
    "F10-signs": {"c": 1511.0, "k": 2.751, "gamma": 2.689e7, "k_i": 430.2},
}


@pytest.mark.thorough
@compiled
@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow if x == "F10-signs" else pytest.mark.thorough) for x in TUNED]
)
def test_correct_c_passes_for_every_seed(name, tmp_path):
    text = (TASKS / f"{name}.toml").read_text().partition("[tune]")[0]
    text = text.replace('kind = "kalman"', 'kind = "kalman"\nw = 393.7')
    for gain, value in TUNED[name].items():
        text = re.sub(rf"^{gain} = .*$", f"{gain} = {value}", text, flags=re.MULTILINE)
    (tmp_path / "task.toml").write_text(text.replace("duration = 1.0", "duration = 0.5"))
    case = read_case(tmp_path / "task.toml")
    made = drafts(case.cascade, count=100, scenario=case.scenario)
    machines = {to: library(one.files["amb.c"], one, tmp_path, to) for to, one in made.items()}
    for seed in range(examples(2, 6)):
        scenario = dataclasses.replace(case.scenario, seed=seed)
        found = closed_loop.compare_loops(
            LoopCase(case.cascade, scenario, case.clock.with_method(RK4(3)), case.settle), machines
        )
        for precision, one in found.items():
            assert one.horizon.decisive, (precision, seed)
            assert one.times < 1, (precision, seed, one.times)
