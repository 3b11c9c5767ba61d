"""A custom law that a case file names: `kind = "FILE.py:CLASS"`, in every command, in other processes, tuned."""

import json
import pathlib
import pickle
import subprocess
import sys
import tomllib

import jax
import pytest
from profiles import thorough
from texts import refusal, write

from ambjax.__main__ import main
from ambjax.cases.reader import read_case
from tuning.report.folder import tuned_case

LAW = '''
import jax.numpy as jnp
from ambjax.extend import PositionLaw, force_for, gain, record

print("a remark of the file")


@record
class PD(PositionLaw):
    """Proportional and derivative, with an integral."""

    spring: float = gain(default=1e4, unit="1/s^2", doc="proportional gain")
    damp: float = gain(default=400.0, unit="1/s", doc="derivative gain")

    def init(self, model):
        return jnp.zeros(())

    def scale(self, model):
        return 1.0

    def slope(self, model):
        return self.damp

    def sigma(self, motion, reference):
        return motion.z_dot - reference.r_dot + self.spring / self.damp * (motion.z - reference.r)

    def __call__(self, model, inputs, state):
        motion, reference = inputs
        wanted = -self.damp * self.sigma(motion, reference) - state
        return force_for(0.0, model, motion, reference, wanted), 10 * self.spring * (motion.z - reference.r)
'''
CASE = """
processor = { delay = 1.0 }
controller.inversion = { gamma = 7.97e5, p = inf }
controller.current = { k_i = 870.6, p = inf }
sensor = { std = 1e-6, std_z_dot = 1e-4 }
actuator = { u_max = 200.0 }
clock = { duration = 0.01 }
tune = { objective = "least_error", limits.sensitivity = inf, gains = ["controller.position.damp"] }
[controller.position]
kind = "mine.py:PD"  # ours
damp = 300.0
"""
IMPORTED = "case.toml: controller.position.kind: imported PD from "

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def case(elsewhere):
    write(LAW, "mine.py")
    return write(CASE)


@pytest.mark.parametrize(
    "command",
    [
        pytest.param("simulate --out there", marks=pytest.mark.slow),
        thorough("ensemble --members 3 --out there"),
        thorough("check"),
        thorough("sensitivity --out there"),
        thorough("map --x controller.position.spring=8e3:1e4:2 --y plant.m=-1%:1%:2"),
        "export --out there",
    ],
)
def test_every_command_accepts_a_custom_law_and_prints_the_imported_file(command, case, capsys):
    assert main([*command.split(), case, "--json"]) in (0, 1)
    out, err = capsys.readouterr()
    json.loads(out)  # what the file prints does not stand on stdout
    assert err.count(f"{IMPORTED}{pathlib.Path('mine.py').resolve()}\n") == 1


def test_nothing_is_imported_unless_a_case_names_it(case, capsys):
    write("raise SystemExit(3)", "mine.py")
    read_case(write("[clock]\nduration = 0.01\n", "plain.toml"))
    assert "importing it raised SystemExit: 3 (line 1)." in refusal(capsys, "simulate", "case.toml")


def test_a_path_is_relative_to_the_case_file(case, monkeypatch):
    pathlib.Path("below").mkdir()
    write(LAW, "below/mine.py")
    write(CASE, "below/case.toml")
    write("raise ValueError", "mine.py")
    law = read_case("below/case.toml").cascade.position
    monkeypatch.chdir("below")
    # the same class, so that compiled programs are shared
    assert jax.tree.structure(law) == jax.tree.structure(read_case("case.toml").cascade.position)
    absolute = CASE.replace("mine.py", str(pathlib.Path("mine.py").resolve()))
    assert type(read_case(write(absolute, "../absolute.toml")).cascade.position) is type(law)


def test_an_installed_module_is_imported_by_its_name(case, monkeypatch):
    write(LAW, "my_installed_laws.py")
    monkeypatch.syspath_prepend(".")
    named = CASE.replace("mine.py:", "my_installed_laws:")
    found = read_case(write(named)).own_laws[0]
    assert (found.law.__module__, found.file) == ("my_installed_laws", None)
    assert str(found) == "controller.position.kind: imported PD from my_installed_laws"
    assert len(found.digest) == 64
    assert type(pickle.loads(pickle.dumps(found.law()))) is found.law


# What is wrong, the law's file, `kind`, what the message contains.
WRONG = {
    "no file": (LAW, "other.py:PD", ["other.py cannot be read (No such file", "relative to the folder of the case"]),
    "no class": (LAW, "mine.py:PDD", ["mine.py has no class 'PDD'", "mean 'PD'", "Its laws of this stage: 'PD'"]),
    "no law at all": ("x = 1", "mine.py:PD", ["has no class 'PD'", "no subclass of ambjax.extend.PositionLaw"]),
    "no name": (LAW, "mine.py:", ['write "FILE.py:CLASS" or "MODULE:CLASS"']),
    "another stage": (LAW.replace("PositionLaw", "CurrentLaw"), "mine.py:PD", ["no law of this stage", "PositionLaw"]),
    "no record": (LAW.replace("@record", ""), "mine.py:PD", ["PD is no record", "@ambjax.extend.record"]),
    "a method is missing": (LAW.replace("def sigma", "def other"), "mine.py:PD", ["abstract", "sigma", "every method"]),
    "no default": (LAW.replace('damp: float = gain(default=400.0, unit="1/s", doc="derivative gain")', "damp: float"),
                   "mine.py:PD", ["non-default argument 'damp' follows", "(line 8)"]),
    "a field that is no gain": (LAW.replace("@record", "@record", 1).replace(
        "    def init", "    name: str = 'x'\n\n    def init", 1), "mine.py:PD", ["PD.name: declare it by gain(...)"]),
    "the name kind": (LAW.replace("spring", "kind"), "mine.py:PD", ["PD.kind", "Choose another"]),
    "the name of an attribute": (LAW.replace("spring", "analytic"), "mine.py:PD", ["PD.analytic", "Choose another"]),
    "a syntax error": ("def f(:\n", "mine.py:PD", ["importing it raised SyntaxError: invalid syntax (line 1)."]),
    "an error at import": ("x = 1\ny = 1 / 0\n", "mine.py:PD", ["raised ZeroDivisionError: division by zero (line 2)"]),
    "no module": (LAW, "no_such_module:PD", ["raised ModuleNotFoundError: No module named", "Install it"]),
    "an error in a method": (LAW.replace("motion.z_dot", "motion.speed"), "mine.py:PD",
                             ["PD raised AttributeError", "no attribute 'speed' (line 25)"]),
    "an if on a traced value": (LAW.replace("        return force_for", "        if motion.z > 0:\n            pass\n"
                                            "        return force_for"), "mine.py:PD",
                                ["raised TracerBoolConversionError", "jnp.where in place of `if`"]),
    "a rate of another shape": (LAW.replace("10 * self.spring * (motion.z - reference.r)", "()"), "mine.py:PD",
                                ["PD raised TypeError: the rate of the state must be like init(model)"]),
    "an output of another shape": (LAW.replace("return force_for", "return inputs or force_for"), "mine.py:PD",
                                   ["must return the number v_star and the rate"]),
    "a scale of another shape": (LAW.replace("return 1.0", "return 1.0, 2.0"), "mine.py:PD", ["scale(model) must be"]),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_law_is_refused_in_one_line(wrong, case, capsys):
    text, kind, wanted = WRONG[wrong]
    write(text, "mine.py")
    write(CASE.replace("mine.py:PD", kind).replace("damp = 300.0\n", ""))
    before = sorted(pathlib.Path().iterdir())
    for command in (["check"], ["tune"]):
        assert main([*command, "case.toml"]) == 2
        out, err = capsys.readouterr()
        (line,) = (line for line in err.splitlines() if line != "a remark of the file")
        assert out == ""
        assert all(part in line for part in [f'case.toml: controller.position.kind = "{kind}": ', *wanted]), line
    assert sorted(pathlib.Path().iterdir()) == before


def test_keys_are_those_of_the_record(case):
    with pytest.raises(ValueError, match=r"controller\.position\.dmap = 1.*Did you mean 'damp'\? Keys.*spring, damp"):
        read_case(write(CASE.replace("damp = 300.0", "dmap = 1")))
    with pytest.raises(ValueError, match=r"controller\.position\.damp = -1: it must be a finite number above"):
        read_case(write(CASE.replace("damp = 300.0", "damp = -1.0")))
    with pytest.raises(ValueError, match=r'kind = "mine.py": .*\'sliding-mode\'.*or "FILE.py:CLASS"'):
        read_case(write(CASE.replace("mine.py:PD", "mine.py")))


OTHER = """
import pickle, sys
law = pickle.load(sys.stdin.buffer)
assert "mine" not in {name for name in sys.modules if "." not in name}
print(type(law).__qualname__, law.damp, type(pickle.loads(pickle.dumps(law))) is type(law))
"""


def test_a_law_is_unpickled_in_a_process_without_its_file(case):
    sent = pickle.dumps(read_case(case).cascade.position)
    pathlib.Path("mine.py").unlink()
    done = subprocess.run([sys.executable, "-c", OTHER], input=sent, capture_output=True, check=True)
    assert done.stdout.decode() == "PD 300.0 True\n"


@pytest.mark.parametrize(
    ("kind", "out", "wanted"),
    [
        ("mine.py:PD", "there/deep", "../../mine.py:PD"),
        ("./below/../mine.py:PD", ".", "./below/../mine.py:PD"),
        ("{folder}/mine.py:PD", "there", "{folder}/mine.py:PD"),
    ],
)
def test_tuned_toml_names_the_law_relative_to_its_own_folder(kind, out, wanted, case):
    here, folder = pathlib.Path.cwd(), pathlib.Path(out)
    pathlib.Path("below").mkdir()
    one = read_case(write(CASE.replace("mine.py:PD", kind.format(folder=here))))
    folder.mkdir(parents=True, exist_ok=True)
    text, tuned = tuned_case(one, {"controller.position.damp": 500.0}, "held", folder)
    assert tomllib.loads(text)["controller"]["position"] == {"kind": wanted.format(folder=here), "damp": 500.0}
    assert "# ours" in text
    assert read_case(write(text, str(folder / "tuned.toml"))).cascade == tuned.cascade
    assert tuned.cascade.position.damp == 500.0
