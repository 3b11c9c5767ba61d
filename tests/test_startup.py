"""Start of a command: the imported modules are counted, because times depend on the load of the machine."""

import pathlib
import subprocess
import sys

import pytest
from texts import write

import ambjax

ROOT = pathlib.Path(__file__).parent.parent


def loaded(*words):
    """Modules that a command imports, and those of them that are packages of their own."""
    command = [sys.executable, "-X", "importtime", "-m", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("import time:")]
    assert len(lines) > 50
    names = {line.rpartition("|")[2].strip() for line in lines}
    return names | {name.split(".")[0] for name in names}


@pytest.mark.parametrize("program", ["ambjax", "tuning"])
@pytest.mark.parametrize("option", ["--version", "--help"])
def test_help_and_version_import_no_numerical_package(program, option):
    assert not loaded(program, option) & {"jax", "numpy", "scipy", "matplotlib", "optax", "tqdm"}


@pytest.mark.parametrize(("command", "unneeded"), [
    pytest.param("check", {"matplotlib", "optax", "tuning", "ambjax.commands.ensemble", "ambjax.paper.evidence"},
                 marks=pytest.mark.slow),
    pytest.param("simulate", {"scipy", "optax", "tuning", "ambjax.commands.ensemble", "ambjax.paper", "ambjax.theorem"},
                 marks=pytest.mark.thorough),
])  # fmt: skip
def test_a_command_imports_only_the_packages_that_it_needs(tmp_path, command, unneeded):
    sine = "kind = 'sine'\namplitude = 1e-3\nfrequency = 2.0\n"
    case = write(f"[clock]\nduration = 0.02\n[reference]\n{sine}", tmp_path / "short.toml")
    found = loaded("ambjax", command, case, *(("--out", tmp_path) if command == "simulate" else ()))
    assert "jax" in found
    assert not found & unneeded


def test_every_name_of_the_stub_is_public():
    modules = {name for name, home in ambjax._MODULES.items() if home == "ambjax"}
    assert {*ambjax.__all__, *modules} == set(ambjax._MODULES) <= set(dir(ambjax))
    assert all(name in ambjax._MODULES or name.startswith("_") for name in dir(ambjax))
    assert {"laws", "signals", "plants", "sensors", "actuators", "solvers", "extend", "linear", "theorem"} <= modules
    for name, home in ambjax._MODULES.items():
        exec(f"from {home} import {name}", own := {})
        assert getattr(ambjax, name) is own[name]


def test_a_public_name_is_not_replaced_by_the_module_of_that_name():
    code = """
import ambjax.simulation.rollout, types
from ambjax import rollout
assert isinstance(rollout, types.FunctionType) and ambjax.rollout is rollout
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
