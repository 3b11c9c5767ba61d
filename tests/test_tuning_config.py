"""Numbers of [tune]: each has a lower and an upper bound, and the message states both."""

import dataclasses
import math

import numpy as np
import pytest
from texts import case_and_tune

from ambjax.cases.tune_table import NUMBERS, WEIGHTS, Budget
from tuning.front import FACTORS
from tuning.problem.config import LIMIT_RANGE, OTHER_RANGES, read_tune
from tuning.problem.loss import TERMS
from tuning.problem.quantities import KINDS
from tuning.problem.space import tunable
from tuning.problem.tuning_problem import problem_of


def parsed(tune):
    return case_and_tune({"sensor": {"std": 1e-6}, "rotor": {"speed": 6000.0}, "tune": tune})[1]


ENDS = NUMBERS | {f"weights.{name}": WEIGHTS[name] for name in TERMS}
ENDS |= {f"limits.{name}": OTHER_RANGES.get(name, LIMIT_RANGE) for name in [*KINDS, "survival"]}


@pytest.mark.parametrize("path", ENDS)
def test_every_number_of_tune_has_a_lower_and_an_upper_bound(path):
    meta = ENDS[path].metadata
    table, _, name = path.rpartition(".")
    low = meta["above"] if meta["at_least"] is None else meta["at_least"]
    assert -math.inf < low < meta["at_most"] < math.inf

    def read(value):
        return parsed({table: {name: value}} if table else {name: value, "risk": "cvar"})

    assert read(meta["at_most"])
    beyond = np.nextafter(meta["at_most"], math.inf)
    for wrong in (low - 1e-3, beyond, math.nan, -math.inf, *([] if meta["infinite"] else [math.inf])):
        with pytest.raises(ValueError, match=rf"^tune\.{path} = .*: it must be ") as raised:
            read(float(wrong))
        assert f"{meta['at_most']:g}" in str(raised.value)
        assert str(raised.value).isprintable()
    if meta["infinite"]:
        assert read(math.inf)


# Budgets whose members or points are in memory at once.
IN_MEMORY = ("members", "stressed", "validation", "held_out", "screen")


def test_whole_numbers_and_bounds_of_tune_have_a_lower_and_an_upper_bound():
    def bounds(*ends):
        return {"gains": ["controller.position.c"], "bounds": {"controller": {"position": {"c": list(ends)}}}}

    for field in dataclasses.fields(Budget):
        most = 2**20 if field.name in IN_MEMORY else len(FACTORS) if field.name == "front" else 2**31 - 1
        assert getattr(parsed({field.name: most}).budget, field.name) == most
        with pytest.raises(
            ValueError, match=rf"^tune\.{field.name} = {most + 1}: it must be a whole number from [01] to {most}\.$"
        ):
            parsed({field.name: most + 1})
        with pytest.raises(ValueError, match=rf"^tune\.{field.name} = 2\.5: it must be a whole number"):
            parsed({field.name: 2.5})
    for ends in ((0, 1e30), (1, math.inf), (1.0, 1.00001)):
        assert parsed(bounds(*ends)).space.gains[0].high == ends[1]
    beyond = [(0, 1e31), (1e31, math.inf), (10**400, math.inf), (math.inf, math.inf)]
    for ends in (*beyond, (1.0, 1 + 1e-7), (1, math.nan), (True, 5)):
        with pytest.raises(ValueError, match=r"^tune\.bounds\.controller\.position\.c = .*0 <= low < high <= 1e\+30"):
            parsed(bounds(*ends))


def test_settings_of_another_case_apply_except_its_gains(tmp_path):
    """Gains and bounds come from the case; limits, loss and budget may come from another file."""
    own, other = tmp_path / "own.toml", tmp_path / "other.toml"
    own.write_text(
        '[tune]\ngains = ["controller.position.c"]\nmembers = 5\nbounds.controller.position.c = [1.0, 9.0]\n'
        "[tune.limits]\nmax_u_V = 1.0\n"
    )
    other.write_text("[tune]\nseed = 7\nweights.effort = 2.0\n[tune.limits]\nrms_u_V = 8.0\nsensitivity = inf\n")
    _, tune, raw = read_tune(own, other)
    assert [(gain.path, gain.low, gain.high) for gain in tune.space.gains] == [("controller.position.c", 1.0, 9.0)]
    assert [(limit.name, limit.threshold) for limit in tune.limits.each] == [("rms_u_V", 8.0)]
    assert (tune.budget.seed, tune.budget.members, tune.weights[TERMS.index("effort")]) == (7, Budget().members, 2.0)
    assert raw["tune"]["seed"] == 7  # as a checkpoint records it
    assert len(read_tune(other, own)[1].space.gains) > 1
    own.write_text("tune = 3\n")
    with pytest.raises(ValueError, match=r"own\.toml: tune = 3"):
        read_tune(own, other)


MEANT = {
    "rms_u": "rms_u_V",
    "u_max": "max_u_V",
    "i_max": "max_abs_i_A",
    "max_current_A": "max_abs_i_A",
    "rms_i_A": "rms_coil_A",
    "chatter_V": "chatter_V_per_s",
    "max_error_m": "largest_error_m",
    "settling_time_s": "settling_s",
    "settling_band": "settling_band_m",
    "clearance": "clearance_used",
    "sensitivty": "sensitivity",
    "complimentary": "complementary",
    "KS": "control_sensitivity",
    "delay_margin": "delay_margin_s",
    "members": "tune.members",
    "effort": "tune.weights.effort",
}


@pytest.mark.parametrize("key", MEANT)
def test_a_misspelt_limit_suggests_the_right_key(key):
    with pytest.raises(ValueError, match=rf"^tune\.limits\.{key} = 0\.5: .* Did you mean '{MEANT[key]}'\?"):
        parsed({"limits": {key: 0.5}})
    with pytest.raises(ValueError, match=rf"^tune\.limits\.{key} = {{.*}}: .* Did you mean '{MEANT[key]}'\?"):
        parsed({"limits": {key: {"value": 0.5}}})


def test_a_limit_in_another_table_suggests_the_path_of_the_limit():
    for name in KINDS:
        with pytest.raises(ValueError, match=rf"^tune\.{name} = 0\.5: .* Did you mean 'tune\.limits\.{name}'\?"):
            parsed({name: 0.5})
    with pytest.raises(ValueError, match=r"tune\.limit = .* Did you mean 'limits'\?"):
        parsed({"limit": {}})


@pytest.mark.parametrize("kind", ["sliding-mode", "integral-sliding-mode", "super-twisting", "utkin-sliding-mode"])
def test_the_gains_of_explicit_set_valued_signs_have_ranges(kind):
    """The sign has no slope, and the processor steps it explicitly.

    The ranges of its gains are those of implicit signs.
    """
    laws = {"position": {"kind": kind, "p": math.inf}, "inversion": {"p": math.inf}, "current": {"p": math.inf}}

    def found(discretisation):
        processor = {"delay": 1.0, "discretisation": discretisation}
        document = {"controller": laws, "processor": processor, "sensor": {"std": 1e-6}, "clock": {"duration": 0.004}}
        gains = {"gains": [path for path in tunable(case_and_tune(document)[0].cascade) if not path.endswith(".p")]}
        problem = problem_of(*case_and_tune(document, **gains))
        return dict(zip(gains["gains"], ((one.low, one.high) for one in problem.ranges), strict=True))

    explicit, implicit = found("explicit"), found("implicit")
    assert all(0 < low < high < math.inf for low, high in explicit.values())
    others = explicit.keys() - {"controller.inversion.gamma"}  # whose range is wider for implicit signs
    assert {path: explicit[path] for path in others} == {path: implicit[path] for path in others}
