"""The JavaScript back end: every primitive, every block, and the loop, run by node and compared with JAX."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from javascript import run_rows, with_node
from test_export_blocks import CASES
from test_export_emitter import LOOSE, check_functions, listed
from texts import refusal, write

from ambjax.__main__ import main
from ambjax.cases.template_text import template as case_template
from ambjax.codegen.block import Block
from ambjax.codegen.javascript.script import HELPERS, script
from ambjax.codegen.loop_step import block_of
from ambjax.codegen.points import results, verification_points
from ambjax.codegen.trace import trace

pytestmark = with_node


class Functions(Block):
    """All functions of two numbers as the outputs of a block."""

    noun = "test"
    ports = staticmethod(lambda *x: x)
    inputs = dict.fromkeys("ab", ("1", ""))
    outputs = dict.fromkeys(listed(), ("1", ""))
    bits = dict.fromkeys(["never"], "")
    crowded = ()

    def step(self, parameters, memory, inputs, period, read):
        return memory, tuple(f(*inputs) for f in listed().values()), jnp.asarray(False)

    def start(self):
        return jnp.asarray(False)

    def numbers(self):
        return []

    def states(self):
        return []


# Units in the last place by which JavaScript's functions are off XLA's, where that is more than those of <math.h> are.
LOOSER = {"erf": 32, "erfc": 512, "sinh": 64, "cosh": 64, "arctanh": 256, "logistic": 8, "exp2": 8, "arcsinh": 16}


@pytest.mark.slow
def test_every_primitive_equals_jax(tmp_path):
    text = script(trace(Functions((), 1.0), "double"), "all")
    run = "const s = all.start(), y = new Float64Array(all.outputs.length);\n"
    run += "const run = x => { all.step([], s, x, y); return y; };\n"
    check_functions(lambda x: run_rows(text + run, x, tmp_path), "double", LOOSE | LOOSER)
    assert all(re.search(rf"const {name} = ", text) for name in HELPERS)


STEP = """
const y = new Float64Array(block.outputs.length), np = block.parameters.length, ns = block.states.length + 1;
const run = row => {
  const s = Float64Array.from(row.subarray(np, np + ns));
  const bits = block.step(row.subarray(0, np), s, row.subarray(np + ns), y);
  return [...s, ...y, bits];
};
"""


@pytest.mark.slow
@pytest.mark.parametrize("what", ["controller", "plant", "loop"])
def test_one_step_equals_jax(what, tmp_path):
    traced = trace(block_of(what, *CASES["rig"]), "double")
    at = verification_points(traced, 1000)
    rows = np.concatenate([at.parameters, at.state, [at.started], at.inputs]).T
    found = run_rows(script(traced, "block") + STEP, rows, tmp_path).T
    should = results(traced, at)
    numbers = np.concatenate([should.state, [should.started], should.outputs])
    with np.errstate(all="ignore"):
        off = np.abs(found[:-1] - numbers) / np.maximum(np.abs(numbers), 1e-290)
    same = (found[:-1] == numbers) | (np.isnan(found[:-1]) & np.isnan(numbers))
    # the same operations in the same order: what differs are exp and its like, by units in the last place
    assert np.all(same | (off < 1e-14))
    np.testing.assert_array_equal(found[-1], should.bits)


@pytest.mark.slow
def test_the_command_writes_the_controller_and_refuses_what_javascript_has_not(tmp_path, capsys):
    one, out = write(case_template("rig"), tmp_path / "new.toml"), tmp_path / "js"
    for _ in range(2):  # its own file is replaced
        assert main(["export", str(one), "--format", "js", "--out", str(out)]) == 0
    text = (out / "amb_new.js").read_text()
    run = "const y = new Float64Array(4), s = amb_new.start();\nconst run = x => {"
    run += " amb_new.step(amb_new.values(), s, x, y); return y; };\n"
    (found,) = run_rows(text + run, np.array([[1e-5, 0, 0, 0, 0, 0, 0]]), tmp_path)
    assert found[0] < 0  # the rotor is above the reference: the voltage pulls it down
    capsys.readouterr()
    for option in (["--verify"], ["--precision", "float"]):
        assert option[0] in refusal(capsys, "export", one, "--format", "js", *option)
