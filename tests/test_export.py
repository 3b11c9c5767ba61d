"""The controller as C: every law, a custom law, refused cases, and the verification of faulty C programs."""

import dataclasses
import functools
import hashlib
import json
import re
import shutil
import subprocess
import tempfile
import tomllib
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import THOROUGH
from texts import piped, refusal, write

import ambjax
from ambjax import Cascade, Clock, Scenario
from ambjax.__main__ import main
from ambjax.cases.reader import case_from, read_case
from ambjax.codegen.c99 import machine
from ambjax.codegen.c99.machine import Compiled, build
from ambjax.codegen.c99.package import files_of_trace
from ambjax.codegen.c99.source import MARK, Origin, Writer
from ambjax.codegen.controller import controller_of
from ambjax.codegen.interface import StepInputs
from ambjax.codegen.trace import arguments, trace
from ambjax.codegen.twins import LoopCase
from ambjax.codegen.verify import Check, draft, verify
from ambjax.control import current, inversion, observer, position
from ambjax.control.force import force_for, sliding_variable
from ambjax.control.guard import Guard
from ambjax.control.processor import Processor
from ambjax.extend import PositionLaw
from ambjax.numerics.records import gain, record
from ambjax.plants import Plant
from ambjax.results.case_export import VERIFIED, planned
from ambjax.sensors import Sensor
from ambjax.signals import Sine
from ambjax.solvers import RK4

compiled = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
INF = np.inf
PERIOD = 1e-4
ORIGIN = Origin("test", "0" * 64, [])


@record
class Layered(PositionLaw):
    """A custom position law: a boundary layer of two slopes, by a loop and a branch, with a state."""

    decay: Any = gain(default=17.0, unit="1/s", doc="decay rate on the manifold")
    auto: Any = gain(default=25.0, unit="m/s^2", doc="reaching gain, under a word of C")
    width: Any = gain(default=0.05, unit="m/s", doc="width of the layer")

    def init(self, model):
        return {"mean": jnp.zeros(()), "long": jnp.zeros(())}

    def scale(self, model):
        return {"mean": 0.1, "long": 0.1}

    def slope(self, model):
        return self.auto / self.width

    def sigma(self, motion, reference):
        return sliding_variable(self.decay, motion, reference)

    def __call__(self, model, inputs, state):
        motion, reference = inputs
        sigma, share = self.sigma(motion, reference), 0.0
        for n in range(3):
            share = share + jnp.tanh(sigma / (self.width * 2.0**n)) / 3
        share = jnp.where(motion.z > 0, share, 0.9 * share)
        robust = -self.auto * share - state["mean"]
        rates = {"mean": sigma - state["mean"], "long": state["mean"] - state["long"]}
        return force_for(self.decay, model, motion, reference, robust + state["long"]), rates


def hard(**more):
    """The paper's cascade with set-valued signs and an observer."""
    laws = {
        "observer": observer.Complementary(),
        "position": position.SlidingMode(1440.0, 2.3, INF),
        "inversion": inversion.Adaptive(8e5, INF),
        "current": current.SlidingMode(870.0, INF),
        "processor": Processor(1.0),
    }
    return Cascade(**(laws | more))


CASCADES = {
    "the paper's": Cascade(processor=Processor(1.0)),
    "the sign itself, an observer": hard(),
    "PID, not predicted, another model": hard(
        position=position.PID(), processor=Processor(0.0), model=Plant(m=0.65, n=1400.0)
    ),
    "one and a half": hard(processor=Processor(1.5)),
    "explicit": hard(
        position=position.SlidingMode(), inversion=inversion.Adaptive(), processor=Processor(1.0, implicit=False)
    ),
    "super-twisting, closed form, PI": hard(
        observer=observer.Complementary(3.0, 1e-4),
        position=position.SuperTwisting(),
        inversion=inversion.ClosedForm(),
        current=current.ProportionalIntegral(),
        processor=Processor(1.0, predict=False),
    ),
    "super-twisting, the sign itself": hard(position=position.SuperTwisting(p=INF)),
    "a custom law": hard(position=Layered()),
    "state feedback, an amplifier's current": hard(
        position=position.StateFeedback(), inversion=inversion.Linearised(), current=current.AmplifierCurrent(500.0)
    ),
    "a chain, a differentiator": hard(
        observer=observer.IRED1(),
        position=position.FilterChain(depth_1=0.1, w_z=2000.0, w_lp=1.06e4),
        inversion=inversion.Linearised(),
        processor=Processor(0.5),
    ),
    "integral sliding mode, Kalman": hard(observer=observer.Kalman(), position=position.IntegralSlidingMode(p=INF)),
    "Utkin's sliding mode, a difference, feed-forward, dead-beat": hard(
        observer=observer.Difference(),
        position=position.UtkinSlidingMode(k=2.3, p=INF),
        inversion=inversion.FeedForwardAdaptive(8e5, INF),
        current=current.DeadBeat(),
    ),
    "terminal sliding mode": hard(position=position.TerminalSlidingMode()),
    "a differentiator, explicit": hard(observer=observer.IRED2(), processor=Processor(2.0, implicit=False)),
    "Kalman": hard(observer=observer.Kalman()),
}
# Laws that other cascades have. The thorough profile tests all cascades in both precisions.
REPEATED = ["one and a half", "Kalman", "the paper's", "super-twisting, the sign itself", "explicit"]
EACH_CASCADE = [pytest.param(x, marks=pytest.mark.thorough if x in REPEATED else pytest.mark.slow) for x in CASCADES]
# Loops that are simulated by default, too.
LOOPED = ("the paper's", "super-twisting, the sign itself", "terminal sliding mode")


def drafts(cascade, precisions=("float", "double"), count=10_000, u_max=200.0, scenario=None):
    controller = controller_of(cascade, u_max, PERIOD, scenario)
    origin = Origin("test", "0" * 64, controller.described())
    return {name: draft(controller, name, "amb", origin, count) for name in precisions}


def failed(checks):
    return [x for x in checks if not x.ok]


@compiled
def test_one_step_equals_jax():
    made = drafts(CASCADES["one and a half"], ["double"], 3000)
    assert not failed(verify(made, None))
    # the points are no formality: the voltage is within its limit at many, at its limit, held, and near singular
    bits = made["double"].steps["one step"][1].bits
    assert all(np.sum(bits & bit > 0) >= few for bit, few in {1: 20, 2: 20, 8: 1, 32: 20}.items())
    assert np.sum(bits == 0) > 300
    bits = made["double"].steps["parameters"][1].bits  # and laws fail, with parameters that are no numbers
    assert all(np.sum(bits & bit > 0) > 20 for bit in (1, 2, 4, 8, 16, 32))


@functools.cache
def stepping(cascade):
    """Return the jitted step of a controller with exact sensors, after one step with all inputs 0."""
    controller = controller_of(cascade, 200.0, PERIOD)
    parameters, memory, inputs, period = arguments(controller)
    read = frozenset(StepInputs._fields)
    step = jax.jit(lambda memory, inputs: controller.step(parameters, memory, inputs, period, read))
    memory, answer, status = step(memory, inputs)
    assert not any((status.refused, status.failed, status.singular, status.safe, status.invalid))
    assert memory.started
    return controller, step, memory, inputs, answer


def wrong(limit):
    """Return values that a limit does not allow."""
    return [np.nan, np.inf, -np.inf, 1.001 * limit, -1.001 * limit]


@pytest.mark.slow
def test_an_invalid_reference_does_not_change_the_state():
    controller, step, memory, inputs, answer = stepping(hard())
    for name in StepInputs._fields[3:]:
        limit = getattr(controller.parameters.limits, name)
        for value in wrong(limit):
            bad = inputs._replace(**{name: jnp.asarray(value)})
            after, held, status = step(memory, bad)
            assert (status.invalid, status.refused) == (True, False)
            assert (after.laws, after.last, after.started) == (memory.laws, memory.last, True)
            assert after.before == (memory.last.u,)  # the voltage that is held goes on acting
            assert after.watch.left == 0
            assert held == answer
            first = step(controller.start(), bad)
            assert (first[0].started, first[1].u) == (False, 0)
        good = inputs._replace(**{name: jnp.asarray(0.999 * limit)})
        assert not step(memory, good)[2].invalid


@pytest.mark.parametrize("name", ["z", *(pytest.param(x, marks=pytest.mark.slow) for x in ("z_dot", "i"))])
def test_a_refused_reading_is_replaced_by_the_expected_reading(name):
    controller, step, memory, inputs, _ = stepping(hard())
    guard = controller.parameters.controller.processor.guard
    instead = inputs._replace(**{name: getattr(memory.watch.expected, name)})
    should, answer, status = step(memory, instead)
    assert not status.refused
    for value in wrong(getattr(guard, name)):
        bad = inputs._replace(**{name: jnp.asarray(value)})
        after, found, status = step(memory, bad)
        assert (status.refused, status.safe, status.failed, status.invalid) == (True, False, False, False)
        assert (after.laws, after.last, found) == (should.laws, should.last, answer)
        assert (after.watch.expected, after.watch.left) == (should.watch.expected, guard.samples - 1)
        first = step(controller.start(), bad)
        assert (first[0].started, first[1].u, first[2].safe) == (False, 0, True)


def test_after_the_allowed_number_of_refused_samples_u_is_0_until_a_reading_is_accepted():
    _, step, memory, inputs, _ = stepping(hard(processor=Processor(1.0, guard=Guard(samples=3.0))))
    bad, good = inputs._replace(z=jnp.asarray(np.nan)), inputs._replace(z=jnp.asarray(1e-3))
    for n in range(6):
        before, (memory, answer, status) = memory, step(memory, bad)
        assert (status.refused, status.safe) == (True, n >= 3)
        assert (answer.u == 0) == (n >= 3)
        if n >= 3:
            assert memory.laws == before.laws
    memory, answer, status = step(memory, good)  # however far the rotor has gone
    assert not any((status.refused, status.safe))
    assert answer.u != 0
    far = step(memory, good._replace(z=jnp.asarray(3e-3)))[2]
    assert far.refused  # 2 mm in a sample


def test_after_a_failed_step_the_next_readings_are_accepted():
    """No law has stepped, so that nothing predicts these readings; a refused one gives u = 0."""
    controller, _, _, inputs, _ = stepping(hard())
    parameters, memory, _, period = arguments(controller)
    laws = parameters.controller
    wrong = dataclasses.replace(laws, current=dataclasses.replace(laws.current, k_i=jnp.asarray(np.nan)))
    broken = parameters._replace(controller=wrong)
    read, far = frozenset(StepInputs._fields), inputs._replace(z=jnp.asarray(-2e-3))
    memory, answer, status = controller.step(broken, memory, far, period, read)
    assert (status.failed, status.refused, memory.started, answer.u) == (True, False, False, 0)
    lost = controller.step(parameters, memory, far._replace(z=jnp.asarray(np.nan)), period, read)
    assert (lost[1].u, lost[2].safe, lost[0].started) == (0, True, False)
    memory, answer, status = controller.step(parameters, memory, far, period, read)
    assert (status.refused, status.failed, memory.started) == (False, False, True)
    assert answer.u != 0


def test_a_controller_without_a_measured_velocity_reads_none():
    """Laws that use no velocity, and no observer: the guard predicts with the velocity 0, as in the simulator."""
    kinds = {"observer": "direct", "position": "chain", "inversion": "linearised", "current": "pi"}
    laws = {stage: {"kind": kind} for stage, kind in kinds.items()}
    for velocity in (False, True):
        raw = {"controller": laws, "processor": {"predict": False}, "sensor": {"velocity": velocity}}
        case = case_from(raw)
        controller = controller_of(case.cascade, case.scenario.command_limit, PERIOD, case.scenario)
        assert ("z_dot" in trace(controller, "double").read) == velocity


def test_without_a_guard_every_reading_is_used():
    plain = hard(observer=observer.Direct(), processor=Processor(1.0, guard=None))
    _, step, memory, inputs, answer = stepping(plain)
    _, found, status = step(memory, inputs._replace(z=jnp.asarray(4e-3)))
    assert not any((status.refused, status.failed))
    assert found.u != answer.u
    _, found, status = step(memory, inputs._replace(z=jnp.asarray(np.nan)))
    assert status.failed
    assert found.u == answer.u


@compiled
def test_a_delay_beyond_the_exported_one_is_refused(tmp_path):
    """The number of parts of the prediction is fixed at export: a delay of 1.5 samples would be predicted as 1."""
    traced = trace(controller_of(hard(), 200.0, PERIOD), "double")
    made = placed(tmp_path, text())
    assert not build([tmp_path / "amb.c"], tmp_path / "amb.so", "-shared", "-fPIC")
    library = Compiled(tmp_path / "amb.so", traced, "amb")
    (at,) = (k for k, x in enumerate(traced.parameters) if x.name == "processor.delay")
    for delay, bit in {1.0: 0, 0.0: 0, 0.4: 0, 1.5: 32, np.nextafter(1, 2): 32, -1e-9: 32, np.nan: 32}.items():
        library.parameters[at] = delay
        assert library.step() & 32 == bit, delay
    allowed = "params->processor.delay: from 0 to 1, else every step is invalid"
    assert "amb_real delay; /* [samples, from 0 to 1] " in made["amb.h"]
    assert all(allowed in made[name] for name in ("amb.h", "README.md"))


# --- what is written ---


def written(cascade, to, u_max):
    controller = controller_of(cascade, u_max, PERIOD)
    return files_of_trace(trace(controller, to), "amb", Origin("test", "0" * 64, controller.described()))


kept = functools.cache(written)  # many tests read the same text


def text(cascade=None, to="double", u_max=200.0, **more):
    return kept(cascade or hard(**more), to, u_max)


def placed(folder, files):
    """Write the files of an export to a folder. Return them."""
    for name, content in files.items():
        (folder / name).write_text(content)
    return files


def test_an_export_is_reproducible_and_a_gain_changes_one_number():
    once, again = text(), written(hard(), "double", 200.0)
    assert once == again
    other = text(current=current.SlidingMode(871.0, INF))
    assert once["amb.c"] == other["amb.c"]
    lines = zip(once["amb.h"].splitlines(), other["amb.h"].splitlines(), strict=True)
    assert [pair for pair in lines if pair[0] != pair[1]] == [
        ("        /* k_i */ 870.0 \\", "        /* k_i */ 871.0 \\")
    ]


def test_every_number_is_symbolic_and_declared():
    made = text(position=Layered(), to="float")
    header, source = made["amb.h"], made["amb.c"]
    for field in (one for one in dataclasses.fields(Plant) if one.metadata.get("leaf")):
        assert f"params->model.{field.name}" in source
        assert f"amb_real {field.name}; /* [{field.metadata['unit']}, " in header
        assert field.metadata["doc"] in header
    assert "params->position.auto_" in source
    assert "amb_real auto_; /* [m/s^2, above 1e-30 and at most 1e+30] reaching gain, under a word of C */" in header
    assert "amb_real long_; /* state of Layered */" in header
    assert "/* test_export.Layered */" in source
    # nothing of the model is folded: the constants are the laws' own, and small whole numbers
    numbers = {float(x) for x in re.findall(r"(?<![\w.])(\d+\.?\d*(?:e[+-]?\d+)?)f", source)}
    assert not numbers & {0.588, 754.0, 1480.0, 0.121, 41.44, 9.81}


def test_the_c_uses_neither_dynamic_memory_nor_input_or_output_and_in_double_precision_no_float():
    """A float32 quotient, as JAX refines it, would be slower in C and overflow beyond 1e38."""
    source = re.sub(r"/\*.*?\*/", "", text(cascade=CASCADES["Kalman"])["amb.c"], flags=re.DOTALL)
    assert not re.search(r"\bfloat\b|\b\d+\.\d+(e[+-]?\d+)?f\b|\b(sqrt|fabs|atan)f\(", source)
    made = text()
    for name in ("amb.c", "amb.h"):
        assert set(re.findall(r"#include [<\"](.*)[>\"]", made[name])) <= {"math.h", "stdint.h", "amb.h"}
        assert not re.search(r"\b(malloc|free|printf|static (?!amb_real amb_(max|min|sign)))\b", made[name])


def test_the_papers_cascade_costs_less_than_150_flops_and_its_guard_80():
    cost = {}
    for guard in (Guard(), None):
        header = text(to="float", processor=Processor(1.0, predict=False, guard=guard))["amb.h"]
        cost[guard is None] = int(re.search(r"A step: (\d+) flops\.", header)[1])
    assert cost[True] < 150
    assert cost[False] < cost[True] + 80


FLAGS = ["-Wall", "-Wextra", "-Werror", "-pedantic"]
STANDARDS = ["-std=c99", "-std=c11", *(f"-std=c++{year}" for year in (11, 14, 17, 20))]


def compiles(folder, file, *flags):
    """Return the messages of the compiler for the language of a source."""
    compiler = "g++" if file.endswith(".cpp") else "cc"
    command = [compiler, *FLAGS, *flags, "-c", file, "-o", "out.o"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False).stderr


@compiled
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("to", ["float", "double"])
def test_the_header_compiles_alone_as_the_readme_states(tmp_path, to):
    """It compiles as C and as C++11 or later, with the initialiser in the order of the struct."""
    made = placed(tmp_path, text(to=to, u_max=INF, processor=Processor(1.0, predict=False)))
    (use,) = re.findall(r"`(amb_params mine = AMB_DEFAULT;)`", made["README.md"])
    source = f'#include "amb.h"\namb_real mine(void);\namb_real mine(void)\n{{ {use} return mine.limits.u_max; }}\n'
    for name in ("mine.c", "mine.cpp"):
        (tmp_path / name).write_text(source)
    for standard in STANDARDS:
        assert not compiles(tmp_path, "mine.cpp" if "++" in standard else "mine.c", standard), standard


@compiled
def test_a_compiler_without_nan_is_refused(tmp_path):
    placed(tmp_path, text())
    assert not compiles(tmp_path, "amb.c", "-std=c99", "-O3")
    for flag in ("-ffast-math", "-ffinite-math-only", "-Ofast"):
        assert "NaN and infinity must be detected" in compiles(tmp_path, "amb.c", "-std=c99", flag), flag


@compiled
@pytest.mark.parametrize(
    ("name", "reads"),
    [
        ("the sign itself, an observer", ["z", "z_dot", "i", "r", "r_dot", "r_ddot"]),
        ("Kalman", ["z", "i", "r", "r_dot", "r_ddot"]),
    ],
)
def test_the_example_of_the_readme_compiles_and_sets_the_inputs_of_the_step(tmp_path, name, reads):
    made = placed(tmp_path, text(cascade=CASCADES[name]))
    (example,) = re.findall(r"```c\n(.*?)```", made["README.md"], flags=re.DOTALL)
    assert re.findall(r"input\.(\w+) = \w+\(\);", example) == reads
    (tmp_path / "example.c").write_text(example)
    assert not compiles(tmp_path, "example.c", "-std=c99", "-Wstrict-prototypes")


@compiled
def test_the_stack_is_within_the_bound_of_the_header(tmp_path):
    for to in ("float", "double"):
        made = placed(tmp_path, text(to=to))
        assert not compiles(tmp_path, "amb.c", "-std=c99", "-O0", "-fstack-usage")
        used = max(int(line.split("\t")[1]) for line in next(tmp_path.glob("*.su")).read_text().splitlines())
        assert used <= int(re.search(r"Stack: at most (\d+) bytes", made["amb.h"])[1])


# --- the command ---

CASE = """
[processor]
[controller.position]
p = inf
[controller.inversion]
p = inf
[controller.current]
p = inf
[clock]
duration = 0.01
"""


@pytest.fixture
def case(elsewhere, tmp_path):
    return tmp_path / write(CASE, "rotor.toml")


@compiled
def test_the_directory_compiles_and_tests_itself(case, tmp_path, capsys):
    assert main(["export", str(case), "--out", str(tmp_path / "c"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"] is None
    names = ["Makefile", "README.md", "rotor.c", "rotor.h", "rotor_test.c", "rotor_vectors.h"]
    assert sorted(x.name for x in (tmp_path / "c").iterdir()) == names
    done = subprocess.run(["make", "test"], cwd=tmp_path / "c", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "100 of 100 steps agree with JAX" in done.stdout


def test_export_is_the_command_as_a_function(case, tmp_path, capsys):
    assert main(["export", str(case), "--out", str(tmp_path / "c")]) == 0
    exported = ambjax.export(read_case(case))
    assert exported.ok is None
    assert contents(exported.write(tmp_path / "python")) == contents(tmp_path / "c")
    assert "written: " + str(tmp_path / "c") + "/" + ", ".join(exported.files) in capsys.readouterr().out
    write("all:", "Makefile")
    with pytest.raises(ValueError, match="Makefile exists, is not from an export"):
        exported.write(tmp_path)
    version = "fmi = 2: it is the version of an FMU. Omit fmi, or set format to fmu."  # no options of the command line
    for option, message in (({"what": "loops"}, "what = 'loops'"), ({"fmi": 4}, "fmi = 4"), ({"fmi": 2}, version)):
        with pytest.raises(ValueError, match=message):
            ambjax.export(exported.plan.case, **option)


def test_an_export_has_the_record_of_its_verification(case, tmp_path, monkeypatch):
    """The checks themselves are those of tests/test_export_verify.py."""
    bad = Check("one step, numbers", "float", "0.1 at 2 points", "<1e-5", False)
    monkeypatch.setattr("ambjax.results.case_export.verify.draft", lambda *_: types.SimpleNamespace(files={"a": "b"}))
    monkeypatch.setattr("ambjax.results.case_export.verify.verify", lambda *_: [bad])
    exported = ambjax.export(read_case(case), verify=True)
    assert (exported.ok, exported.checks) == (False, [bad])
    assert list(exported.files) == ["a", *VERIFIED]
    assert json.loads(exported.files["verify.json"])["checks"] == [bad._asdict()]
    assert "<td>&lt;1e-5</td><td>FAILS</td>" in exported._repr_html_()
    assert main(["export", str(case), "--verify", "--out", str(tmp_path / "c")]) == 1
    assert contents(tmp_path / "c") == {name: text.encode() for name, text in exported.files.items()}


def contents(out):
    """Return the contents of a folder."""
    return {x.name: x.read_bytes() if x.is_file() else None for x in out.iterdir()}


@compiled
def test_only_files_of_an_earlier_export_of_the_same_prefix_are_replaced(case, tmp_path, capsys):
    out = tmp_path / "c"
    assert main(["export", str(case), "--out", str(out)]) == 0
    case.write_text(CASE.replace("0.01", "0.02"))
    before = contents(out)
    placed(out, dict.fromkeys(VERIFIED, MARK.format(p="rotor")))  # of the controller that was there before
    assert main(["export", str(case), "--out", str(out), "--precision", "double"]) == 0
    after = contents(out)
    assert set(after) == set(before)
    assert [name for name in before if before[name] != after[name]] == [x for x in before if x != "Makefile"]
    # nor is what another prefix or a person wrote, whatever stands in the others' place
    capsys.readouterr()
    assert f"--out {out}: Makefile exists" in refusal(capsys, "export", case, "--out", out, "--prefix", "roto")
    others = {
        "README.md": lambda path: path.write_bytes(b"mine \xff"),
        "verify.json": lambda path: path.write_text("{}"),
        "rotor.c": lambda path: path.mkdir(),
        "Makefile": lambda path: path.symlink_to("nowhere"),
    }
    for name, make in others.items():
        (other := tmp_path / name).mkdir()
        make(other / name)
        held = contents(other)
        assert f"--out {other}: {name} exists" in refusal(capsys, "export", case, "--out", other)
        assert contents(other) == held
    assert contents(out) == after


def test_a_case_from_a_pipe_is_read_once(elsewhere, tmp_path):
    assert main(["export", piped(CASE), "--prefix", "amb", "--out", str(tmp_path / "c"), "--json"]) == 0
    digest = hashlib.sha256(CASE.encode()).hexdigest()
    assert f"SHA-256 of the case: {digest} */" in (tmp_path / "c" / "amb.h").read_text()


def test_only_a_case_as_it_was_read_has_a_checksum(tmp_path):
    (tmp_path / "amb.toml").write_text(CASE)
    case, digest = read_case(tmp_path / "amb.toml"), hashlib.sha256(CASE.encode()).hexdigest()
    changed = ambjax.with_gains(case, {"controller.position.c": 300.0})
    made = case_from(tomllib.loads(CASE), "amb")
    moved = dataclasses.replace(case, scenario=dataclasses.replace(case.scenario, u_max=99.0))
    plans = [planned(one, "controller", "c", None, None, None, False) for one in (case, changed, made, moved)]
    assert [plan.origin.digest for plan in plans] == [digest, "", "", ""]
    for plan in plans[:2]:
        shown = types.SimpleNamespace(trace=plan, prefix="amb", origin=plan.origin)  # of a `Writer`
        assert ("SHA-256" in Writer.banner(shown, "amb.h")) == bool(plan.origin.digest)  # pyright: ignore


def test_what_cannot_be_exported_is_refused_in_one_line(case, tmp_path, capsys, monkeypatch):
    out = tmp_path / "c"
    plain = write("[clock]\nduration = 0.01\n", "plain.toml")
    assert "[processor] is missing" in refusal(capsys, "export", plain, "--out", out)
    for option in ("--precision half", "--prefix 1st", "--prefix math"):
        assert option.partition(" ")[0] in refusal(capsys, "export", case, "--out", out, *option.split())
    assert "cannot write there" in refusal(capsys, "export", case, "--out", tmp_path / plain / "c")
    monkeypatch.setenv("CC", "no-such-compiler")
    assert "there is no C compiler (no-such-compiler)" in refusal(capsys, "export", case, "--out", out, "--verify")
    assert not out.exists()


LAST = 'while [ "$1" != -o ]; do shift; done; '
NO_SANITIZER = 'case "$*" in *sanitize*) echo "ld: cannot find -lasan" >&2; exit 1 ;; esac; exec cc "$@"'


@compiled
@pytest.mark.parametrize(
    ("does", "message"),
    [
        ("\0", "the C compiler {cc} cannot be run (Exec format error)"),
        ("#!/bin/sh\necho error: sick >&2; exit 1", "{cc} cannot make a program that works (sick)"),
        (f'#!/bin/sh\ncc "$@" || exit 1; {LAST} chmod a-x "$2"', "the output of {cc} cannot be run in "),
        (f"#!/bin/sh\n{NO_SANITIZER}", "{cc} cannot make a sanitized program that works (cannot find -lasan). Install"),
    ],
    ids=["no program", "compiles nothing", "its output may not run", "no sanitizers"],
)
def test_a_failing_compiler_is_reported(case, tmp_path, capsys, monkeypatch, does, message):
    (cc := tmp_path / "mycc").write_text(does)
    cc.chmod(0o755)
    monkeypatch.setenv("CC", str(cc))
    assert f"--verify: {message.format(cc=cc)}" in refusal(capsys, "export", case, "--out", tmp_path / "c", "--verify")
    assert not (tmp_path / "c").exists()


def test_a_compiler_that_cannot_run_is_reported_with_the_option_that_needs_it(tmp_path, monkeypatch):
    (cc := tmp_path / "mycc").write_text("\0")
    cc.chmod(0o755)
    monkeypatch.setenv("CC", str(cc))
    with pytest.raises(ValueError, match=r"^--format fmu: the C compiler .* cannot be run .*, or use --format c\.$"):
        build([tmp_path / "a.c"], tmp_path / "a", asked=machine.FMU)


@compiled
def test_programs_that_do_not_end_or_have_no_temporary_folder_are_not_judged(case, tmp_path, capsys, monkeypatch):
    out = ("--out", tmp_path / "c", "--verify")
    monkeypatch.setattr(machine, "TIME_LIMIT", 1e-9)
    assert "did not end within 1e-09 s, so the check is not decided" in refusal(capsys, "export", case, *out)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    assert "cannot write to the folder for temporary files (No such file" in refusal(capsys, "export", case, *out)
    assert not (tmp_path / "c").exists()


def test_a_law_that_cannot_be_exported_is_named():
    @record
    class Table(position.SlidingMode):
        def __call__(self, model, inputs, state):
            wanted, state = super().__call__(model, inputs, state)
            return jnp.interp(wanted, jnp.arange(3.0), jnp.arange(3.0)), state

    cascade = hard(position=Table(), processor=Processor(1.0, implicit=False))
    with pytest.raises(ValueError, match=r"test_export\..*Table: the primitive .* cannot be written as scalar code"):
        text(cascade)
    with pytest.raises(ValueError, match=r"controller.current.k_i has the shape \(2,\): only scalars"):
        written(hard(current=current.SlidingMode(np.array([1.0, 2.0]))), "double", 200.0)


@compiled
@pytest.mark.parametrize("name", EACH_CASCADE)
def test_every_kind_of_law_is_exported_and_verified(name):
    cascade, number = CASCADES[name], list(CASCADES).index(name)
    scenario = Scenario(reference=Sine(1e-3, 2.0), sensor=Sensor(1e-6, 1e-4, 1e-4), u_max=200.0)
    case = LoopCase(cascade, scenario, Clock(1000, PERIOD, RK4(3)), 0.02)
    if THOROUGH:
        assert not failed(verify(drafts(cascade, scenario=scenario), case))
        return
    one = drafts(cascade, [("float", "double")[number % 2]], 3000, scenario=scenario)
    assert not failed(verify(one, case if name in LOOPED else None))
