"""Space, risk and loss of the tuner: bijections, invariants, closed forms."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from texts import case_and_tune

from ambjax import Cascade, Clock, Initial, Processor, Scenario, rollout
from ambjax.laws import current, inversion
from ambjax.signals import Pulse, Sine
from ambjax.simulation.folds import Rms
from ambjax.solvers import Slide
from tuning.problem.gains_table import off
from tuning.problem.goal import CVaR
from tuning.problem.loss import TERMS, loss_for
from tuning.problem.space import CLOSEST, MARGIN, Gain, Space, tunable

GAINS = [Gain("controller.position.c"), Gain("controller.position.c", 3.0), Gain("controller.position.c", 2.0, 5e3)]
C, K = "controller.position.c", "controller.position.k"


@pytest.mark.parametrize("gain", [*GAINS, Gain("controller.position.c", 0.0, 5e3)])
def test_coordinates_are_a_bijection(gain):
    values = np.geomspace(max(gain.low, 1e-3) * 1.001, min(gain.high, 1e6) * 0.999, 50)
    # rounding of log and exp, magnified next to a bound by gain / (gain - bound) = 1e3
    np.testing.assert_allclose(gain.decode(jnp.asarray(gain.encode(values))), values, rtol=1e-11)
    low = np.log(gain.low) - 2 if gain.low > 0 and np.isfinite(gain.high) else -6.0
    x = jnp.linspace(low, min(np.log(gain.high) + 2, 6.0), 25)
    # two beyond a bound it is e^-8 away, which magnifies rounding by 3000
    np.testing.assert_allclose(gain.encode(np.asarray(gain.decode(x))), x, atol=1e-8)
    assert np.all(np.diff(gain.decode(x)) > 0)


@settings(max_examples=300, derandomize=True, deadline=None, database=None)
@given(
    st.just(0.0) | st.floats(-30, 29).map(lambda x: 10**x),
    st.just(math.inf) | st.floats(math.log10(2 * CLOSEST), 30).map(lambda x: 10**x),
    st.floats(-0.5, 1.5),
)
@example(1.0, 0.01, 0.5)
def test_every_interval_has_gains_well_within_and_their_coordinates(low, way, share):
    gain = Gain(C, low, low + (way if low == 0 else way * low))
    start = low * (1 + way) ** share if low > 0 and math.isfinite(way) else share
    value = float(Space((gain,)).clip(np.array([start]))[0])
    assert low < value < gain.high
    if low < start < gain.high and low > 0:
        assert abs(math.log(value / start)) <= math.log(1 + MARGIN) * (1 + 1e-12)
        if 0.11 < share < 0.89 and math.isfinite(way):
            assert value == start or way > 0.1
    # the logarithms of 1e30 are 70, rounded in their last digit, and an exponential makes that a relative error
    assert float(gain.decode(jnp.asarray(Space((gain,)).encode([value])[0]))) == pytest.approx(value, rel=1e-12, abs=0)
    assert low <= float(gain.decode(jnp.asarray(-700.0))) <= float(gain.decode(jnp.asarray(700.0))) <= gain.high


def test_a_search_begins_where_a_gain_depends_on_its_coordinate():
    """Drawn back, a gain is within 4 % of its bound, and its slope is above a tenth. Other coordinates stay."""
    space = Space((Gain("controller.position.c", 2.0, 500.0), Gain("controller.position.k", 0.0, 9.0)))
    x = np.array([math.log(500.0) + 5.0, math.log(9.0) + 5.0])
    start = space.drawn_back(x)
    np.testing.assert_allclose(space.gains_at(jnp.asarray(start)), [500.0, 9.0], rtol=0.04)
    slopes = np.diag(jax.jacobian(space.gains_at)(jnp.asarray(start))) / [500.0, 9.0]
    assert np.all(slopes > 0.1)
    inside = np.array([1.0, -30.0])
    np.testing.assert_array_equal(space.drawn_back(inside), inside)
    np.testing.assert_array_equal(Space((Gain("controller.position.c", 3.0),)).drawn_back(inside[:1]), inside[:1])


@pytest.mark.parametrize(
    ("gains", "says"), [((), "empty"), ((Gain(C), Gain(C)), "twice"), ((Gain(C, 5.0, 2.0),), "low < high")]
)
def test_an_impossible_space_is_refused(gains, says):
    with pytest.raises(ValueError, match=says):
        Space(gains)


def test_a_start_outside_the_bounds_is_refused_by_its_path():
    with pytest.raises(ValueError, match=r"controller\.position\.c = 17.*100"):
        Space((Gain(C, 100.0),)).encode([17.0])


def test_only_positive_gains_are_tunable():
    found = tunable(Cascade())
    assert {"controller.position.c", "controller.inversion.gamma", "controller.current.k_i"} <= set(found)
    assert "controller.inversion.i_ref" not in found


def test_a_gain_that_is_0_is_tuned_neither_by_default_nor_by_name():
    path = "controller.position.k_int"
    given = {"controller": {"position": {"kind": "pid", "k_int": 0.0}}, "actuator": {"u_max": 200.0}}
    case, tune = case_and_tune(given)
    assert path not in tune.space.paths
    assert "controller.position.k_p" in tune.space.paths
    assert off(case.cascade) == [path]
    with pytest.raises(ValueError, match=r"tune\.gains: controller\.position\.k_int is 0 or inf .* value above 0"):
        case_and_tune(given | {"tune": {"gains": [path]}})


def test_gains_without_effect_are_left_out():
    """The dead-beat law uses share for implicit steps, and w for explicit ones and in continuous time."""
    cascade = Cascade(current=current.DeadBeat())
    for processor, used in ((None, "w"), (Processor(), "share"), (Processor(implicit=False), "w")):
        found = tunable(dataclasses.replace(cascade, processor=processor))
        assert [path for path in found if "current" in path] == [f"controller.current.{used}"]
    assert len(tunable(cascade, idle=True)) == len(found) + 1


def test_a_processor_tunes_finite_steepnesses_by_default():
    """In continuous time no steepness is tuned. On a processor, those of set-valued signs are not tuned."""
    text = {"controller": {"inversion": {"p": math.inf}}, "actuator": {"u_max": 200.0}}
    continuous = case_and_tune({"actuator": {"u_max": 200.0}})[1].space.paths
    assert not [path for path in continuous if path.endswith(".p")]
    sampled = case_and_tune(text | {"processor": {}})[1].space.paths
    assert [path for path in sampled if path.endswith(".p")] == ["controller.position.p", "controller.current.p"]
    assert set(continuous) < set(sampled)


# --- risk ---


def test_cvar_is_the_mean_of_the_worst_share():
    losses = jnp.asarray([5.0, 1.0, 4.0, 2.0, 3.0])
    assert float(CVaR(0.6)(losses)) == pytest.approx(4.5)
    # half of the second worst: (5 + 0.5 * 4) / 1.5
    assert float(CVaR(0.7)(losses)) == pytest.approx(7.0 / 1.5)
    assert float(CVaR(0.0)(losses)) == pytest.approx(3.0)
    np.testing.assert_allclose(jax.grad(CVaR(0.6))(losses), [0.5, 0, 0.5, 0, 0], atol=1e-15)
    np.testing.assert_allclose(jax.grad(CVaR(0.7))(losses).sum(), 1.0)


# --- loss ---

SMOOTH = Cascade(inversion=inversion.Adaptive(1e9, 25e-6))
TRACKING = Scenario(reference=Sine(2.5e-3, 2.0), q_v=Pulse(1.0, 0.01, 0.03), u_max=200.0)
CLOCK = Clock(400, 1e-4, Slide(2))


def terms(cascade, scenario, fold, clock=CLOCK):
    return rollout(cascade, scenario, clock, fold=fold, record_every=0).metrics


def test_tracking_is_the_settled_mean_square():
    found = terms(SMOOTH, TRACKING, loss_for(TRACKING, 0.01))
    assert set(found) == set(TERMS)
    settled = terms(SMOOTH, TRACKING, Rms("e_z", 0.01))
    assert float(found["tracking"]) == pytest.approx((float(settled) / 5e-3) ** 2, rel=1e-12)
    # a 16-norm lies between the rms and the maximum
    assert float(found["tracking"]) < float(found["peak"])
    assert float(found["survival"]) == float(found["clearance"]) == 0.0


def lost_late(gamma):
    """Return the survival term of a loop whose gamma is too small: the rotor is lost within the horizon."""
    cascade = dataclasses.replace(SMOOTH, inversion=inversion.Adaptive(gamma, 25.0))
    return terms(cascade, dataclasses.replace(TRACKING, initial=Initial(1e-4)), loss_for(TRACKING, 0.01))["survival"]


def test_the_derivative_of_the_survival_points_to_longer_survival():
    value, slope = jax.jvp(lost_late, (3e4,), (3e4,))
    assert 0 < float(value) < 1
    assert float(slope) < 0
    h = 1e-3
    difference = (float(lost_late(3e4 * (1 + h))) - float(lost_late(3e4 * (1 - h)))) / (2 * h)
    # lost_at itself is read at the end of a substep, 50 us of 40 ms, whence the noise of the difference
    assert float(slope) == pytest.approx(difference, rel=0.3, abs=50e-6 / 0.04 / (2 * h))
