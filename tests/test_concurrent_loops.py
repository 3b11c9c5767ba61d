"""The linearised loops of many members are computed on two cores, where calls of LAPACK would wait for each other."""

import os
import subprocess
import sys

import numpy as np
import pytest
import tomlkit

from ambjax.cases.template_text import template
from ambjax.numerics.small_matrices import solve

PROGRAM = """
import sys
from tuning.problem.config import read_tune
from tuning.problem.loops import loops
from tuning.problem.tuning_problem import problem_of

case, tune, _ = read_tune(sys.argv[1])
problem = problem_of(case, tune)
x = tune.space.encode(tune.space.values(case.cascade))
loops(problem.objective, x[None].repeat(4, 0), problem.objective.members(0, 16))
"""


@pytest.mark.thorough
def test_a_limit_on_the_delay_margin_does_not_stop_two_cores(tmp_path):
    raw = tomlkit.parse(template("bearing"))
    raw["tune"] = {"limits": {"delay_margin_s": 1e-5}}
    path = tmp_path / "case.toml"
    path.write_text(tomlkit.dumps(raw))
    # XLA's pool has as many threads as NPROC; a program that waits for ever is ended after 4 minutes
    env = os.environ | {"NPROC": "2", "JAX_ENABLE_X64": "1"}
    subprocess.run([sys.executable, "-c", PROGRAM, str(path)], check=True, timeout=240, env=env)


def test_elimination_solves_systems_that_need_pivoting():
    random = np.random.default_rng(0)
    A = random.standard_normal((40, 9, 9)) + 1j * random.standard_normal((40, 9, 9))
    A[:, np.arange(9), np.arange(9)] = 0.0
    B = random.standard_normal((40, 9, 2))
    # condition numbers up to 1e3
    np.testing.assert_allclose(np.asarray(solve(A, B)), np.linalg.solve(A, B), rtol=1e-11, atol=1e-11)
