"""Programs are traced once: a second process takes them from disk, with the same results, and never a wrong one."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from ambjax.compiler import traced_programs
from ambjax.compiler.fast_path import one_kernel
from ambjax.compiler.short_compilation import compiled_quickly
from ambjax.numerics.relax import relax

# Prints a result of a rollout. In a run with the argument "again", a trace of the rollout raises an error.
PROCESS = """
import sys
import ambjax
from ambjax.ensemble.worker import configure_jax
from ambjax.simulation import rollout

def begin(*_):
    raise AssertionError("traced again")

configure_jax()
if sys.argv[1] == "again":
    rollout.begin = begin
print(float(ambjax.simulate(ambjax.read_case(sys.argv[2])).metrics["rms_error_m"]).hex())
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    traced_programs.store_in(tmp_path / "traced")
    yield tmp_path / "traced"
    monkeypatch.setattr(traced_programs, "_folder", None)


def stored(folder):
    return sorted(folder.glob("*"))


@pytest.mark.slow
def test_a_process_traces_nothing_that_another_one_has_traced(tmp_path):
    (tmp_path / "case.toml").write_text("processor = {}\nclock.duration = 0.01\ncontroller.position.kind = 'pid'\n")
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    del environment["JAX_COMPILATION_CACHE_DIR"]
    shown = []
    for word in ("first", "again"):
        command = [sys.executable, "-c", PROCESS, word, str(tmp_path / "case.toml")]
        process = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert process.returncode == 0, process.stderr
        shown.append(process.stdout)
    assert shown[0] == shown[1]


W, H = np.linspace(-1, 1, 5), np.float64(0.1)
# float64 and float32, another length, a number of Python, another static argument, another structure.
KINDS = (W, H, 0.5), (np.float32(W), np.float32(H), 0.5), (W[1:], H, 0.5), (W, 0.1, 0.5), (W, H, 0.25), (W, H, None)


@pytest.mark.parametrize("door", [one_kernel, compiled_quickly])
def test_each_kind_of_argument_has_a_program_of_its_own_with_the_results_of_the_function(door, folder):
    expected = jax.jit(relax, static_argnames="p")
    for _ in range(2):  # the second time, each program is read
        function = door(relax, static_argnames=("p",))
        for w, h, p in KINDS:
            result, right = function(w, h, p=p), expected(w, h, p=p)
            assert (result.dtype, result.weak_type) == (right.dtype, right.weak_type)
            np.testing.assert_array_equal(result, right)
        assert len(stored(folder)) == len(KINDS)


def test_a_damaged_file_is_replaced(folder):
    expected = compiled_quickly(relax, static_argnames=("p",))(W, H, p=0.5)
    (path,) = stored(folder)
    right = path.read_bytes()
    for wrong in (b"", right[: len(right) // 2]):
        path.write_bytes(wrong)
        np.testing.assert_array_equal(compiled_quickly(relax, static_argnames=("p",))(W, H, p=0.5), expected)
        assert len(path.read_bytes()) == len(right)


def own_law(x):
    return 2 * x


def inner_function():
    def inner(x):
        return 2 * x

    inner.__module__ = relax.__module__  # as if a function of the project had returned it
    return inner


@pytest.mark.parametrize("function", [own_law, inner_function()], ids=["a user's", "an inner one of the project"])
def test_a_function_that_the_source_of_the_project_does_not_define_is_traced_every_time(function, folder):
    assert compiled_quickly(function)(np.float64(1.5)) == 3.0
    assert not folder.exists()


class Own:
    """A record of a user in the arguments of a function of the project."""


jax.tree_util.register_pytree_node(Own, lambda own: ((), None), lambda facts, parts: Own())


def test_a_function_with_a_users_own_record_is_traced_every_time(folder):
    assert compiled_quickly(jax.tree.leaves)((1.0, Own())) == [1.0]
    assert not folder.exists()


def test_derivatives_and_maps_of_a_stored_program_are_those_of_the_function(folder):
    function = one_kernel(relax, static_argnames=("p",))
    function(W, 0.1, p=0.5)
    slopes, expected = (jax.vmap(jax.grad(lambda w, f=f: f(w, 0.1, p=0.5)))(W) for f in (function, relax))
    np.testing.assert_array_equal(slopes, expected)


def test_another_source_or_setting_has_other_programs(tmp_path, monkeypatch):
    source = tmp_path / "ambjax" / "compiler" / "one.py"
    source.parent.mkdir(parents=True)
    monkeypatch.setattr(traced_programs, "__file__", str(source))
    keys = []
    for text, setting in (("a", "0"), ("b", "0"), ("b", "1")):
        source.write_text(text)
        monkeypatch.setenv("AMBJAX_PLAIN", setting)
        keys.append(traced_programs._versions.__wrapped__())
    assert len(set(keys)) == 3


def test_the_least_recently_used_half_of_a_full_folder_is_deleted(folder, monkeypatch):
    function = compiled_quickly(relax, static_argnames=("p",))
    for p in (0.5, 0.25, 0.75):
        function(W, H, p=p)
    for age, path in enumerate(stored(folder)):
        os.utime(path, (age, age))
    oldest = stored(folder)[0]
    monkeypatch.setattr(traced_programs, "MOST_STORED", 1)
    function(W, H, p=0.6)
    assert len(stored(folder)) == 2
    assert oldest not in stored(folder)
