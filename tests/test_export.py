"""The controller as C: every law, one of one's own, what is refused, and what a wrong C would do to the proof."""

import dataclasses
import hashlib
import json
import re
import shutil
import subprocess
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from texts import piped

from ambjax import RK4, Cascade, Clock, Plant, Scenario, Sensor, Sine
from ambjax.__main__ import main
from ambjax.cases.template import template
from ambjax.commands.export import VERIFIED
from ambjax.control import current, inversion, observer, position
from ambjax.control.position import force_for, sliding_variable
from ambjax.control.processor import Processor
from ambjax.export import loop, machine
from ambjax.export.controller import Inputs, controller_of
from ambjax.export.machine import Compiled, build
from ambjax.export.package import described, files
from ambjax.export.source import Origin, Writer
from ambjax.export.texts import MARK
from ambjax.export.trace import arguments, trace
from ambjax.export.verify import draft, verify
from ambjax.numerics.records import gain, record
from ambjax.paper import readings
from ambjax.simulation.metrics import standard_for

compiled = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
INF = np.inf
PERIOD = 1e-4
ORIGIN = Origin("test", "0" * 64, [])


@record
class Layered:
    """A position law of a user: a boundary layer of two slopes, by a loop and a branch, with a state."""

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
    """The paper's cascade with the sign itself, and an observer."""
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
    "not predicted, another model": hard(processor=Processor(0.0), model=Plant(m=0.65, n=1400.0)),
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
    "a law of one's own": hard(position=Layered()),
    "Kalman": hard(observer=observer.Kalman()),
    "a difference": hard(observer=observer.Difference(), inversion=inversion.ClosedForm()),
    "a differentiator": hard(observer=observer.IRED1(), processor=Processor(0.5)),
    "a differentiator of order 2": hard(observer=observer.IRED2()),
    "a differentiator, explicit": hard(observer=observer.IRED2(), processor=Processor(2.0, implicit=False)),
}
# What the fast suite looks at; the slow one at all, in both precisions.
FAST = [("one and a half", "double"), ("super-twisting, the sign itself", "float"), ("a law of one's own", "double")]
FAST += [("Kalman", "float")]


def drafts(cascade, precisions=("float", "double"), count=10_000, u_max=200.0):
    controller = controller_of(cascade, u_max, PERIOD)
    origin = Origin("test", "0" * 64, described(controller))
    return {name: draft(controller, name, "amb", origin, count) for name in precisions}


def failed(checks):
    return [x for x in checks if not x.ok]


@compiled
@pytest.mark.parametrize(("name", "to"), FAST)
def test_one_step_is_jaxs(name, to):
    made = drafts(CASCADES[name], [to], 3000)
    checks = verify(made, None)
    assert {x.name.partition(",")[0] for x in checks} == {"compiles", "test program", "library", "one step"}
    assert not failed(checks)
    # the points are no formality: the voltage is within its limit at many, at its limit, held, and near singular
    bits = made[to].results.bits
    assert all(np.sum(bits & bit > 0) > 20 for bit in (1, 2)), np.bincount(bits)
    assert np.sum(bits == 0) > 300


@compiled
def test_the_loop_of_a_case_is_jaxs():
    scenario = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(1e-6, 1e-4, 1e-4), u_max=200.0)
    cascade, clock = hard(observer=observer.Direct()), Clock(200, PERIOD, RK4(1))
    checks = verify(drafts(cascade, count=100), loop.Case(cascade, scenario, clock, standard_for(0.005, scenario)))
    assert not failed(checks)
    assert [x.precision for x in checks if x.name == "closed loop, dz"] == ["float", "double"]


SIGMA, PEAK, SEEN = "settled_max_abs_sigma_m_per_s", "max_abs_error_m", "sigma_reached_s"


def worst(reference, looped, own=None):
    """The metric that is off most of made-up ones, how far it is off, and how far it may be."""
    z, scenario = np.zeros(3), Scenario()
    case = loop.Case(None, scenario, Clock(3, PERIOD), standard_for(0.0, scenario))
    loops = (loop.Loop(z, metrics) for metrics in (reference, own or reference, looped))
    first, *rest, last = loops
    found = loop._compared(first, rest, last, "double", case)
    return found.metric, found.off, found.off_allowed


@pytest.mark.parametrize(
    ("should", "found", "bad"),
    [
        ({"lost": 0.0, PEAK: 1e-3}, {"lost": 0.0, PEAK: 2e-3}, PEAK),  # nothing allowed, nothing off: no matter
        ({"lost": 0.0, PEAK: 1e-3}, {"lost": 1.0, PEAK: 2e-3}, "lost"),  # nothing allowed, and off: the worst
        ({PEAK: 1e-3, "rms_u_V": 1.0}, {PEAK: 1e-3, "rms_u_V": np.nan}, "rms_u_V"),
        ({"lost_at_s": INF, PEAK: 1e-3}, {"lost_at_s": INF, PEAK: 2e-3}, PEAK),
        ({PEAK: 1e-3, "lost_at_s": INF}, {PEAK: 1e-3, "lost_at_s": 0.1}, "lost_at_s"),
        ({SEEN: 0.0, PEAK: 1e-3}, {SEEN: 3 * PERIOD, PEAK: 1e-3}, SEEN),
        ({SIGMA: 1e-3, PEAK: 1e-3}, {SIGMA: 1.05e-3, PEAK: 1e-3}, SIGMA),  # within a sample, were it a time
    ],
)
def test_every_metric_of_the_loop_is_judged(should, found, bad):
    for turn in (lambda metrics: metrics, lambda metrics: dict(reversed(metrics.items()))):
        name, off, allowed = worst(turn(should), turn(found))
        assert name == bad
        assert not off <= allowed


def test_what_a_metric_near_zero_may_be_off_is_of_its_unit():
    plant, free = Plant(), loop.ROUNDINGS * np.finfo(float).eps
    assert worst({SEEN: 0.0}, {SEEN: PERIOD}) == (SEEN, PERIOD, PERIOD)
    assert worst({SIGMA: 0.0}, {SIGMA: 0.0})[2] == pytest.approx(free * plant.sigma_size, abs=0)
    assert worst({PEAK: 0.0}, {PEAK: 0.0})[2] == pytest.approx(free * plant.s_0, abs=0)
    # where rounding alone lets JAX's own loop lose the rotor or not, either is allowed, and the rest is judged
    own = {"lost_at_s": 0.1, PEAK: 1e-3}
    assert worst({"lost_at_s": INF, PEAK: 1e-3}, {"lost_at_s": 0.2, PEAK: 2e-3}, own)[0] == PEAK


def test_an_input_that_is_none_is_refused_and_leaves_no_trace():
    controller = controller_of(hard(), 200.0, PERIOD)
    parameters, memory, inputs, period = arguments(controller)
    read = frozenset(Inputs._fields)
    step = jax.jit(lambda memory, inputs: controller.step(parameters, memory, inputs, period, read))
    memory, answer, status = step(memory, inputs)
    assert not any((status.refused, status.failed, status.singular))
    assert memory.started
    for name in Inputs._fields:
        limit = getattr(parameters.limits, name)
        for wrong in (np.nan, np.inf, -np.inf, 1.001 * limit, -1.001 * limit):
            bad = inputs._replace(**{name: jnp.asarray(wrong)})
            after, held, told = step(memory, bad)
            assert told.refused
            assert (after.laws, after.last, after.started) == (memory.laws, memory.last, True)
            assert after.before == memory.last.u  # the voltage that is held goes on acting
            assert held == answer
            first = step(controller.start(), bad)
            assert (first[0].started, first[1].u) == (False, 0)
        good = inputs._replace(**{name: jnp.asarray(0.999 * limit)})
        assert not step(memory, good)[2].refused


@compiled
def test_a_delay_beyond_the_exported_one_is_refused(tmp_path):
    """The prediction's parts are fixed: of 1.5 samples it would carry 1 and say nothing."""
    traced = trace(controller_of(hard(), 200.0, PERIOD), "double")
    made = text()
    for name in ("amb.h", "amb.c"):
        (tmp_path / name).write_text(made[name])
    assert not build([tmp_path / "amb.c"], tmp_path / "amb.so", "-shared", "-fPIC")
    library = Compiled(tmp_path / "amb.so", traced, "amb")
    (at,) = (k for k, x in enumerate(traced.parameters) if x.name == "processor.delay")
    for delay, bit in {1.0: 0, 0.0: 0, 0.4: 0, 1.5: 2, np.nextafter(1, 2): 2, -1e-9: 2, np.nan: 2}.items():
        library.parameters[at] = delay
        assert library.step() & 2 == bit, delay
    told = "params->processor.delay: from 0 to 1, else every step is refused"
    assert "amb_real delay; /* [samples, from 0 to 1] " in made["amb.h"]
    assert all(told in made[name] for name in ("amb.h", "README.md"))


@pytest.mark.parametrize(
    ("processor", "told"),
    [
        (Processor(1.5), "from 0 to 2"),
        (Processor(0.0, predict=True), "from 0 to 0"),
        (Processor(0.0), "not read"),
        (Processor(1.0, predict=False), "not read"),
    ],
)
def test_the_header_says_what_delay_may_be_set(processor, told):
    traced = trace(controller_of(hard(processor=processor), 200.0, PERIOD), "float")
    header = Writer(traced, "amb", ORIGIN).header()
    assert f"amb_real delay; /* [samples, {told}] " in header
    assert (f"processor.delay: {told}" in header) == (told != "not read")


# --- what is written ---


def text(cascade=None, to="double", u_max=200.0, **more):
    controller = controller_of(cascade or hard(**more), u_max, PERIOD)
    return files(controller, to, "amb", Origin("test", "0" * 64, described(controller)))


def test_twice_the_same_bytes_and_a_gain_is_one_number():
    once, again = text(), text()
    assert once == again
    other = text(current=current.SlidingMode(871.0, INF))
    assert once["amb.c"] == other["amb.c"]
    lines = zip(once["amb.h"].splitlines(), other["amb.h"].splitlines(), strict=True)
    assert [pair for pair in lines if pair[0] != pair[1]] == [
        ("    .current.k_i = 870.0, \\", "    .current.k_i = 871.0, \\")
    ]


def test_every_number_is_symbolic_and_declared():
    made = text(position=Layered(), to="float")
    header, source = made["amb.h"], made["amb.c"]
    fields = {field.name: field for field in dataclasses.fields(Plant) if field.metadata.get("leaf")}
    for name, field in fields.items():
        assert f"params->model.{name}" in source
        assert f"amb_real {name}; /* [{field.metadata['unit']}, " in header
        assert field.metadata["doc"] in header
    assert "params->position.auto_" in source
    assert "amb_real auto_; /* [m/s^2, above 1e-30 and at most 1e+30] reaching gain, under a word of C */" in header
    assert "amb_real long_; /* state of Layered */" in header
    assert "/* test_export.Layered */" in source
    # nothing of the model is folded: the constants are the laws' own, and small whole numbers
    numbers = {float(x) for x in re.findall(r"(?<![\w.])(\d+\.?\d*(?:e[+-]?\d+)?)f", source)}
    assert not numbers & {0.588, 754.0, 1480.0, 0.121, 41.44, 9.81}


def test_float_is_float_throughout():
    source = text(cascade=CASCADES["the paper's"], to="float")["amb.c"]
    source = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    assert not re.search(r"\b\d+\.\d+(e[+-]?\d+)?\b(?!f)", source)
    assert "double" not in source
    assert not re.search(r"\b(sqrt|fabs)\(", source)


def test_neither_memory_nor_input_nor_output_of_c_is_used():
    made = text()
    for name in ("amb.c", "amb.h"):
        assert set(re.findall(r"#include [<\"](.*)[>\"]", made[name])) <= {"math.h", "stdint.h", "amb.h"}
        assert not re.search(r"\b(malloc|free|printf|static (?!amb_real amb_(max|min|sign)))\b", made[name])


def test_the_papers_cascade_costs_less_than_150_flops():
    plain = trace(controller_of(hard(processor=Processor(1.0, predict=False)), 200.0, PERIOD), "float")
    assert plain.flops() < 150
    told = text(to="float", processor=Processor(1.0, predict=False))["amb.h"]
    assert f"A step: {plain.flops()} flops." in told
    assert trace(controller_of(hard(), 200.0, PERIOD), "float").flops() < 280  # RK4 over the delay: 4 times the model


@compiled
@pytest.mark.parametrize("to", ["float", "double"])
def test_the_header_compiles_by_itself_as_the_readme_says(tmp_path, to):
    made = text(to=to, u_max=INF, processor=Processor(1.0, predict=False))
    (use,) = re.findall(r"`(amb_params mine = AMB_DEFAULT;)`", made["README.md"])
    (tmp_path / "amb.h").write_text(made["amb.h"])
    (tmp_path / "mine.c").write_text(
        f'#include "amb.h"\namb_real mine(void);\namb_real mine(void)\n{{ {use} return mine.limits.u_max; }}\n'
    )
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    done = subprocess.run(["cc", *flags, "-c", "mine.c"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@compiled
def test_the_stack_is_within_what_the_header_says(tmp_path):
    for to in ("float", "double"):
        made = text(to=to)
        for name, content in made.items():
            (tmp_path / name).write_text(content)
        subprocess.run(["cc", "-std=c99", "-O0", "-fstack-usage", "-c", "amb.c"], cwd=tmp_path, check=True)
        used = max(int(line.split("\t")[1]) for line in (tmp_path / "amb.su").read_text().splitlines())
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
    path = tmp_path / "rotor.toml"
    path.write_text(CASE)
    return path


@compiled
def test_the_directory_compiles_and_tests_itself(case, tmp_path, capsys):
    assert main(["export", str(case), "--out", str(tmp_path / "c"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"] is None
    names = ["Makefile", "README.md", "rotor.c", "rotor.h", "rotor_test.c", "rotor_vectors.h"]
    assert sorted(x.name for x in (tmp_path / "c").iterdir()) == names
    done = subprocess.run(["make", "test"], cwd=tmp_path / "c", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "100 of 100 steps as JAX makes them" in done.stdout


def contents(out):
    """What a folder holds."""
    return {x.name: x.read_bytes() if x.is_file() else None for x in out.iterdir()}


@compiled
def test_only_files_of_an_earlier_export_of_the_same_prefix_are_replaced(case, tmp_path, capsys):
    out = tmp_path / "c"
    assert main(["export", str(case), "--out", str(out)]) == 0
    case.write_text(CASE.replace("0.01", "0.02"))
    before = contents(out)
    for name in VERIFIED:  # of the controller that was there before
        (out / name).write_text(MARK.format(p="rotor"))
    assert main(["export", str(case), "--out", str(out), "--precision", "double"]) == 0
    after = contents(out)
    assert set(after) == set(before)
    assert [name for name in before if before[name] != after[name]] == [x for x in before if x != "Makefile"]
    # nor is what another prefix or a person wrote, whatever stands in the others' place
    capsys.readouterr()
    for prefix in ("roto", "rotor2"):
        assert f"--out {out}: Makefile is there" in refused(capsys, case, "--out", out, "--prefix", prefix)
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
        said = refused(capsys, case, "--out", other)
        assert f"--out {other}: {name} is there already" in said
        assert contents(other) == held
    assert contents(out) == after


def test_a_case_from_a_pipe_is_read_once(elsewhere, tmp_path):
    assert main(["export", piped(CASE), "--prefix", "amb", "--out", str(tmp_path / "c"), "--json"]) == 0
    digest = hashlib.sha256(CASE.encode()).hexdigest()
    assert f"SHA-256 of the case: {digest} */" in (tmp_path / "c" / "amb.h").read_text()


def refused(capsys, *arguments):
    """The one line on stderr, of a command that is refused."""
    try:
        code = main(["export", *map(str, arguments)])
    except SystemExit as stop:
        code = stop.code
    said = capsys.readouterr()
    assert code == 2
    assert said.out == ""
    assert len(said.err.strip().splitlines()) == 1
    return said.err


def test_what_cannot_be_exported_is_refused_in_one_line(case, tmp_path, capsys, monkeypatch):
    out = tmp_path / "c"
    plain = tmp_path / "plain.toml"
    plain.write_text("[clock]\nduration = 0.01\n")
    assert "[processor] is missing" in refused(capsys, plain, "--out", out)
    assert "--precision" in refused(capsys, case, "--out", out, "--precision", "half")
    assert "--prefix 1st" in refused(capsys, case, "--out", out, "--prefix", "1st")
    assert "--prefix math" in refused(capsys, case, "--out", out, "--prefix", "math")
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert "cannot write there" in refused(capsys, case, "--out", blocked / "c")
    monkeypatch.setenv("CC", "no-such-compiler")
    assert "there is no C compiler (no-such-compiler)" in refused(capsys, case, "--out", out, "--verify")
    assert not out.exists()


LAST = 'while [ "$1" != -o ]; do shift; done; '
# What a compiler does, as a script, and what is told of it.
COMPILERS = {
    "it is no program": ("\0", "the C compiler {cc} cannot be run (Exec format error)"),
    "it compiles nothing": (
        "#!/bin/sh\necho error: sick >&2; exit 1",
        "{cc} makes no program that works here (sick)",
    ),
    "nothing that it makes may run": (
        f'#!/bin/sh\ncc "$@" || exit 1; {LAST} chmod a-x "$2"',
        "what {cc} made cannot be run in ",
    ),
    "it has no sanitizers": (
        '#!/bin/sh\ncase "$*" in *sanitize*) echo "ld: cannot find -lasan" >&2; exit 1 ;; esac; exec cc "$@"',
        "{cc} makes no sanitized program that works here (cannot find -lasan). Install libasan",
    ),
    "its sanitizers fail": (
        f'#!/bin/sh\ncc "$@" || exit 1; case "$*" in *sanitize*) {LAST} echo "echo no ptrace; exit 1" | '
        'sed "1i #!/bin/sh" > "$2" ;; esac',
        "{cc} makes no sanitized program that works here (no ptrace)",
    ),
    "its libraries are none": (
        f'#!/bin/sh\ncc "$@" || exit 1; case "$*" in *-shared*) {LAST} echo > "$2" ;; esac',
        "what {cc} made cannot be loaded in ",
    ),
}


@compiled
@pytest.mark.parametrize(("does", "told"), COMPILERS.values(), ids=COMPILERS)
def test_a_machine_that_decides_nothing_is_told_as_that(case, tmp_path, capsys, monkeypatch, does, told):
    (cc := tmp_path / "mycc").write_text(does)
    cc.chmod(0o755)
    monkeypatch.setenv("CC", str(cc))
    assert f"--verify: {told.format(cc=cc)}" in refused(capsys, case, "--out", tmp_path / "c", "--verify")
    assert not (tmp_path / "c").exists()


@compiled
def test_programs_that_do_not_end_or_find_no_room_decide_nothing(case, tmp_path, capsys, monkeypatch):
    out = ("--out", tmp_path / "c", "--verify")
    monkeypatch.setattr(machine, "PATIENCE", 1e-9)
    assert "did not end within 1e-09 s, and nothing is decided" in refused(capsys, case, *out)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    assert "cannot write to the folder for temporary files (No such file" in refused(capsys, case, *out)
    with pytest.raises(ValueError, match="cannot write to the folder for temporary files"):
        verify({}, None)
    assert not (tmp_path / "c").exists()


def test_a_law_that_is_no_scalar_code_is_named():
    @record
    class Table(position.SlidingMode):
        def __call__(self, model, inputs, state):
            wanted, state = super().__call__(model, inputs, state)
            return jnp.interp(wanted, jnp.arange(3.0), jnp.arange(3.0)), state

    cascade = hard(position=Table(), processor=Processor(1.0, implicit=False))
    with pytest.raises(ValueError, match=r"test_export\..*Table: the primitive .* cannot be written as scalar C"):
        text(cascade)
    with pytest.raises(ValueError, match=r"controller.current.k_i has the shape \(2,\): only scalars"):
        text(current=current.SlidingMode(np.array([1.0, 2.0])))


# --- slow: all of it ---


@compiled
@pytest.mark.slow
@pytest.mark.parametrize("reading", readings.READINGS)
def test_the_readings_cascades(reading):
    cascade = dataclasses.replace(readings.cascade(reading), processor=Processor(1.0))
    scenario = readings.scenario("tracking", reading)
    case = loop.Case(cascade, scenario, Clock(5000, PERIOD, RK4(3)), standard_for(0.1, scenario))
    assert not failed(verify(drafts(cascade, u_max=scenario.u_max), case))


@compiled
@pytest.mark.slow
@pytest.mark.parametrize("name", CASCADES)
def test_all_of_it(name):
    cascade = CASCADES[name]
    scenario = Scenario(reference=Sine(1e-3, 2.0), sensor=Sensor(1e-6, 1e-4, 1e-4), u_max=200.0)
    case = loop.Case(cascade, scenario, Clock(1000, PERIOD, RK4(3)), standard_for(0.02, scenario))
    assert not failed(verify(drafts(cascade), case))


@compiled
@pytest.mark.slow
@pytest.mark.parametrize("to", ["float", "double"])
def test_the_rig(tmp_path, to):
    path = tmp_path / "rig.toml"
    path.write_text(
        template("rig").replace("duration = 0.3 ", "duration = 0.1 ").replace("stop = 0.2 ", "stop = 0.15 ")
    )
    assert main(["export", str(path), "--out", str(tmp_path / "c"), "--precision", to, "--verify"]) == 0


MUTANTS = {
    "a sum is a difference": (r"(v\d+) \+ (v\d+)", r"\1 - \2"),
    "a product is a sum": (r"(v\d+) \* (v\d+)", r"\1 + \2"),
    "a choice is turned": (r"(= v\d+ \? )(v\d+) : (v\d+)", r"\1\3 : \2"),
    "a comparison is turned": (r"(v\d+) > (v\d+)", r"\1 < \2"),
    "a comparison takes the border in": (r"<= params->limits\.z\b", "< params->limits.z"),
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
@pytest.mark.slow
def test_every_mutant_is_found():
    made = drafts(hard(processor=Processor(1.0, predict=False)), ["double"])
    for says, (old, new) in MUTANTS.items():
        one = made["double"]
        source, count = re.subn(old, new, one.files["amb.c"], count=1)
        assert count == 1, says
        mutant = dataclasses.replace(one, files={**one.files, "amb.c": source})
        assert failed(verify({"double": mutant}, None)), says


@compiled
@pytest.mark.slow
def test_random_controllers():
    random = np.random.default_rng(7)

    def decades(value, span=2.0):
        return float(value) * 10.0 ** random.uniform(-span, span)

    def drawn(law, share=0.3):
        gains = [f for f in dataclasses.fields(law) if "steepness" in f.metadata]
        values = {f.name: decades(getattr(law, f.name)) for f in gains}
        steep = [f.name for f in gains if f.metadata["steepness"]]
        return dataclasses.replace(law, **values | {name: INF for name in steep if random.random() < share})

    kinds = {
        "observer": [observer.Direct, observer.Complementary],
        "position": [position.SlidingMode, position.SuperTwisting, Layered],
        "inversion": [inversion.Adaptive, inversion.ClosedForm],
        "current": [current.SlidingMode, current.ProportionalIntegral],
    }
    for n in range(100):
        laws = {stage: drawn(options[random.integers(len(options))]()) for stage, options in kinds.items()}
        numbers = {f.name: decades(getattr(Plant(), f.name), 0.5) for f in dataclasses.fields(Plant)}
        processor = Processor(float(random.choice([0.0, 0.5, 1.0, 1.5, 2.0])), bool(random.random() < 0.7))
        cascade = Cascade(**laws, model=Plant(**numbers), processor=processor)
        made = drafts(cascade, [("float", "double")[n % 2]], 2000, float(random.choice([INF, 48.0, 200.0])))
        assert not failed(verify(made, None)), (n, cascade)
