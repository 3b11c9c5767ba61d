"""Verification of the exported C: each check fails for a program with a matching fault, none for a correct one."""

import dataclasses

import numpy as np
import pytest
from test_export import PERIOD, compiled, drafts, failed, hard

from ambjax import Clock, Scenario
from ambjax.codegen import closed_loop
from ambjax.codegen.block import UNREAD
from ambjax.codegen.points import evaluated
from ambjax.codegen.twins import LEAST, SIGNALS, Horizon, LoopCase
from ambjax.codegen.verify import Check, _looped, checks_page, checks_verdict, holds, verify
from ambjax.control import position
from ambjax.sensors import Sensor
from ambjax.signals import Sine
from ambjax.solvers import RK4

INF = np.inf


@pytest.mark.slow
def test_every_parameter_changes_the_result_at_some_point():
    """If the C contained this parameter as a constant, a number or a bit would differ at some point."""
    made = drafts(hard(position=position.SlidingMode(1440.0, 2.3)), ["double"], 4000)["double"]
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


def horizon(samples, of=100):
    zeros = dict.fromkeys(SIGNALS, np.zeros(of))
    return Horizon(zeros, {name: np.linspace(0, 1e-6, of) for name in SIGNALS}, dict.fromkeys(SIGNALS, 1.0), samples)


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


# For each row of the table a change for which it, of all rows of its kind, fails: the file, and what is replaced.
STEP, COUNTS = "    uint32_t status = 0u;", "    int failed = 0, faults = 0;"
ROWS = {
    "compiles": ("amb.c", STEP, f"{STEP}\n    int unused;"),
    "compiles, sanitized": ("amb.c", STEP, f"#ifdef __SANITIZE_ADDRESS__\n#error no\n#endif\n{STEP}"),
    "test program": ("amb_test.c", "return failed > 0 || faults > 0;", "return 1;"),
    "test program, sanitized": ("amb_test.c", COUNTS, f"{COUNTS} volatile int m = INT32_MAX; faults += m + 1 > 0;"),
    "library": ("amb.c", STEP, f"#if __PIC__ == 2 && !defined(__PIE__)\n#error no\n#endif\n{STEP}"),
    "one step, numbers": ("amb.c", "output->v_star = ", "output->v_star = 1.000001 * "),
    "one step, status": ("amb.c", "status |= amb_SINGULAR;", "status |= 0u;"),
    "parameters, numbers": ("amb.c", "params->position.c", "1440.0"),
    "parameters, status": ("amb.c", "params->limits.near", "0.1"),
    "closed loop, dz": ("amb.c", "params->position.c", "((1 + 1e-9) * params->position.c)"),
}
# Faults of one program, none of which hides another.
TOGETHER = [
    ["compiles"],
    ["compiles, sanitized", "test program", "library"],
    ["test program, sanitized", "parameters, numbers", "parameters, status"],
    ["one step, numbers", "one step, status"],
    ["closed loop, dz"],
]


@compiled
@pytest.mark.slow
def test_every_check_fails_for_a_program_with_its_fault():
    scenario = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(1e-6, 1e-4, 1e-4), u_max=200.0)
    made = drafts(hard(), ["double"], 2000, scenario=scenario)["double"]
    case = LoopCase(hard(), scenario, Clock(200, PERIOD, RK4(1)), 0.005)
    rows = verify({"double": made}, case)
    assert not failed(rows)
    assert {x.name for x in rows} == set(ROWS) == {name for names in TOGETHER for name in names}
    for names in TOGETHER:
        files = dict(made.files)
        for file, old, new in map(ROWS.get, names):
            assert old in files[file], names
            files[file] = files[file].replace(old, new)
        mutant = {"double": dataclasses.replace(made, files=files)}
        found = {x.name: x.ok for x in verify(mutant, case if names == ["closed loop, dz"] else None)}
        assert not any(found[name] for name in names), (names, found)
