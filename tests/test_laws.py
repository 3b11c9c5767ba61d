"""Every law of every stage against one conformance table, and the paper's identities. Eqs. (5)-(11).

A new law joins by adding a row to LAWS.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Clock, Scenario, rollout
from ambjax.control import current, inversion, observer, position
from ambjax.control.base import scaled_steepness
from ambjax.control.cascade_state import Sample
from ambjax.control.force import linear_mechanics
from ambjax.control.pid import PIDState
from ambjax.control.search import LowerBound, SearchContext
from ambjax.control.stages import CurrentDemand, CurrentInputs, ForceDemand
from ambjax.numerics.records import validate
from ambjax.numerics.smooth import smooth_sign
from ambjax.plants import Plant
from ambjax.signals import Pulse, Sine
from ambjax.solvers import AdaptiveRodas3
from ambjax.world.amplifier import CurrentAmplifier
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference, reference_at

# stage, law
LAWS = [
    ("observer", observer.Direct()),
    ("observer", observer.Complementary()),
    ("observer", observer.Complementary(l=3.0, z_hat=1e-4)),
    ("observer", observer.Difference()),
    ("observer", observer.Kalman()),
    ("observer", observer.IRED1()),
    ("observer", observer.IRED2()),
    ("position", position.SlidingMode()),
    ("position", position.SuperTwisting()),
    ("position", position.IntegralSlidingMode()),
    ("position", position.UtkinSlidingMode()),
    ("position", position.TerminalSlidingMode()),
    ("position", position.FeedbackLinearisation()),
    ("position", position.StateFeedback()),
    ("position", position.FilterChain()),
    ("position", position.FilterChain(w_lp=1e4)),
    ("position", position.PID()),
    ("position", position.LinearController()),
    ("inversion", inversion.Adaptive()),
    ("inversion", inversion.Adaptive(gamma=1e9, p=25e-6, i_ref=0.01)),
    ("inversion", inversion.FeedForwardAdaptive()),
    ("inversion", inversion.ClosedForm()),
    ("inversion", inversion.Linearised()),
    ("current", current.SlidingMode()),
    ("current", current.ProportionalIntegral()),
    ("current", current.DeadBeat()),
    ("current", current.OpenLoop()),
    ("current", current.AmplifierCurrent()),
]
MODEL = Plant()
TABLE = pytest.mark.parametrize(
    ("stage", "law"), LAWS, ids=[f"{s}-{type(x).__name__}-{i}" for i, (s, x) in enumerate(LAWS)]
)

TAME = np.array([1e-4, 2e-3, 0.01, 0.02, 0.3, 4e3])
# finite numbers that no real loop produces: a displacement of metres, a current of kiloamperes
WILD = np.array(
    [np.where(np.arange(6) == j, s * 1e4, s * x) for j in range(6) for s in (1, -1) for x in (0.0, 1e-3, 10.0)]
)


def inputs_of(stage, x):
    """The stage's input from six numbers."""
    x = jnp.asarray(x, float)
    return {
        "observer": Measurement(x[0], x[1], x[2]),
        "position": (Measurement(x[0], x[1], x[2]), Reference(x[3] / 10, x[4], x[5] / 1e3)),
        "inversion": ForceDemand(x[0], x[1], x[5], x[4] * 1e5),
        "current": CurrentInputs(Measurement(x[0], x[1], x[2]), CurrentDemand(x[3], x[4]), jnp.abs(x[5]) + 1.0),
    }[stage]


def start(stage, law):
    return law.init(MODEL, inputs_of("observer", TAME)) if stage == "observer" else law.init(MODEL)


def call(stage, law, x=TAME, state=None):
    return law(MODEL, inputs_of(stage, x), start(stage, law) if state is None else state)


def has_state(law):
    return bool(jax.tree.leaves(law.scale(MODEL)))


def gains(law):
    """Names of the fields that hold a number."""
    named = [f.name for f in dataclasses.fields(law) if f.metadata.get("leaf")]
    return [name for name in named if getattr(law, name) is not None]


# --- conformance ---


@TABLE
def test_slope_is_finite_and_positive_if_the_law_has_positive_gains(stage, law):
    slope = law.slope(MODEL)
    assert np.isfinite(slope)
    assert slope >= 0
    # the only numbers of a law that need no slope are those of a model, which the tuner does not change
    positive = [f.name for f in dataclasses.fields(law) if f.metadata.get("leaf") and f.metadata["above"] is not None]
    assert (slope > 0) == bool(positive)
    # a traced gain gives a traced slope, so that a step can be refused with a message
    assert np.isfinite(jax.jit(lambda law: jnp.asarray(law.slope(MODEL)))(law))


def total(stage, law, x, state):
    """Sum of the outputs, each of order one."""
    out, rate = call(stage, law, x, state)
    return sum(jnp.arctan(leaf) for leaf in jax.tree.leaves((out, rate)))


@TABLE
def test_derivatives_in_gains_inputs_and_state_are_finite_and_modes_agree(stage, law):
    arguments = (jax.tree.map(jnp.asarray, law), jnp.asarray(TAME), jax.tree.map(jnp.asarray, start(stage, law)))
    f = lambda law, x, state: total(stage, law, x, state)  # noqa: E731
    reverse, forward = jax.jit(lambda *x: (jax.grad(f, (0, 1, 2))(*x), jax.jacfwd(f, (0, 1, 2))(*x)))(*arguments)
    for a, b in zip(jax.tree.leaves(reverse), jax.tree.leaves(forward), strict=True):
        assert np.all(np.isfinite(a))
        # the same chain rule in another order
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-14 * max(1.0, float(np.max(np.abs(b)))))


@TABLE
def test_output_and_derivatives_are_finite_for_extreme_inputs(stage, law):
    state = jax.tree.map(jnp.asarray, start(stage, law))

    def everything(x):
        return call(stage, law, x, state), jax.jacfwd(lambda x: call(stage, law, x, state))(x)

    for leaf in jax.tree.leaves(jax.jit(jax.vmap(everything))(WILD)):
        assert np.all(np.isfinite(leaf))


@TABLE
def test_output_is_finite_for_extreme_states(stage, law):
    for size in (1e-12, 1.0, 1e6):
        state = jax.tree.map(lambda x, size=size: jnp.asarray(x) * 0 + size, start(stage, law))
        for sign in (1, -1):
            signed = jax.tree.map(lambda x, sign=sign: sign * x, state)
            assert all(np.isfinite(x) for x in jax.tree.leaves(call(stage, law, TAME, signed)))


SITE = SearchContext(
    MODEL, 500.0, 1e-4, {"Q_z": 0.1, "Q_i": 2.0, "Delta_1": 6e4}, LowerBound(6e4, "Delta_1", "along the reference")
)


# sigma, v_tilde or e: the error of the stage; the last so large that any sign is saturated
ERRORS = jnp.asarray([-1e9, -1e-3, 0.0, 1e-3, 1e9])


@TABLE
def test_the_optional_methods_of_a_law_are_consistent(stage, law):
    assert jax.tree.structure(law.layer(MODEL)) == jax.tree.structure(law.scale(MODEL))
    assert all(x > 0 for x in jax.tree.leaves((law.layer(MODEL), law.scale(MODEL))))
    robust = np.asarray(law.robust(ERRORS))
    required = law.requirement
    # a law with a requirement of the theorem has a robust term of at most this gain, which opposes the error
    assert (required is None) == (not robust.any())
    if required:
        assert required.gain in gains(law)
        assert np.all(robust * ERRORS <= 0)
        assert np.max(np.abs(robust)) == pytest.approx(getattr(law, required.gain), rel=0.02)
    steep = [f.name for f in dataclasses.fields(law) if f.metadata.get("steepness")]
    signs = dataclasses.replace(law, **dict.fromkeys(steep, np.inf))
    ranges = [law.ranges(SITE), *(one.ranges(SITE._replace(stepped=True)) for one in (law, signs))]
    for name, interval in itertools.chain(*(found.items() for found in ranges)):
        assert name in gains(law)
        assert not interval.times or interval.times in gains(law)
        assert 0 < interval.low < interval.high < np.inf
        assert interval.source
    assert bool(steep) == (law.size(MODEL) is not None)
    # a plant twice as wide, of the same pole: errors of twice the size meet a sign half as steep
    wide = dataclasses.replace(MODEL, s_0=2 * MODEL.s_0, i_0=MODEL.i_0 * 8**0.5)
    for name in steep:
        ratio = law.size(MODEL) / law.size(wide)
        suited = getattr(scaled_steepness(type(law)(), wide), name)
        assert suited == pytest.approx(ratio * getattr(type(law)(), name), rel=1e-12)
    assert law.slides == isinstance(law, inversion.Adaptive)


GAINS = [(stage, law, name) for stage, law in LAWS for name in gains(law)]


@pytest.mark.parametrize(
    ("stage", "law", "name"), GAINS, ids=[f"{type(x).__name__}-{g}-{i}" for i, (_, x, g) in enumerate(GAINS)]
)
def test_validate_refuses_bad_gains_by_dotted_path(stage, law, name):
    meta = law.__dataclass_fields__[name].metadata
    bad = [np.nan, "high", *([] if meta.get("steepness") else [np.inf])]
    bad += [-1.0] if meta["above"] == 0 or meta["at_least"] == 0 else []
    bad += [0.0, 0] if meta["above"] == 0 else []
    for value in bad:
        with pytest.raises(ValueError, match=rf"^{type(law).__name__}\.{name} = .*must be"):
            dataclasses.replace(law, **{name: value})
    for value in [np.array(x) for one in bad if not isinstance(one, str) for x in (one, [1.0, one])]:
        cascade = Cascade(**{stage: dataclasses.replace(law, **{name: value})})
        with pytest.raises(ValueError, match=rf"^controller\.{stage}\.{name} = .*must be"):
            validate(cascade, "controller")
    for value in (getattr(law, name), 1, np.float32(1.0), np.ones(3), jnp.ones(())):
        validate(Cascade(**{stage: dataclasses.replace(law, **{name: value})}), "controller")
    jax.jit(lambda x: validate(dataclasses.replace(law, **{name: x})))(-1.0)  # traced: not looked at


# --- composition ---

STAGES = ("observer", "position", "inversion", "current")


# the paper's gamma suits the paper's position law: laws of a faster start demand forces that change ten times faster
def accepted(law):
    """Return whether a law can be combined with all laws of other stages; a law that accepts only a voltage cannot."""
    return "force" in getattr(law, "accepts", ("force",))


FAST = [("inversion", inversion.Adaptive(gamma=1e6, p=2.0)), ("observer", observer.IRED2(L=3e5))]  # jerk: 2e5 m/s^3
LAWS_BY_STAGE = [
    list({type(law): law for s, law in [*LAWS[::-1], *FAST] if s == stage and accepted(law)}.values())[::-1]
    for stage in STAGES
]


def pairwise(stages):
    """Return combinations of one law per stage that contain every pair of laws of different stages: a greedy cover."""
    product = list(itertools.product(*map(range, map(len, stages))))
    pairs = {c: set(itertools.combinations(enumerate(c), 2)) for c in product}
    left, chosen = set().union(*pairs.values()), []
    while left:
        best = max(product, key=lambda c: len(pairs[c] & left))
        chosen.append(best)
        left -= pairs[best]
    return [tuple(laws[k] for laws, k in zip(stages, c, strict=True)) for c in chosen]


def how_slow(combinations):
    """Return the mark of each combination.

    Two combinations are fast; those with a law that no earlier one has are slow; the others are thorough.
    """
    seen = set()
    for k, laws in enumerate(combinations):
        new = set(map(type, laws)) - seen
        seen |= new
        yield laws, () if k < 2 else pytest.mark.slow if new else pytest.mark.thorough


# the first has the first law of each stage
COMBINATIONS = [
    pytest.param(laws, id="-".join(type(x).__name__ for x in laws), marks=marks)
    for laws, marks in how_slow(pairwise(LAWS_BY_STAGE))
]
TRACKING = Scenario(reference=Sine(2.5e-3, 2.0), q_v=Pulse(1.0, 0.02, 0.04))


@pytest.mark.parametrize("laws", COMBINATIONS)
def test_every_law_works_with_every_law_of_the_other_stages(laws):
    cascade = Cascade(*laws)
    amplifier = CurrentAmplifier(1e4) if cascade.current.commands == "current" else None
    scenario = dataclasses.replace(TRACKING, amplifier=amplifier)
    method = AdaptiveRodas3() if amplifier is None else None  # with an amplifier: fixed steps, chosen by the rollout
    trajectory = rollout(cascade, scenario, Clock(600, 1e-4, method)).trajectory
    rows = trajectory.rows
    assert trajectory.lost_at == np.inf, trajectory.lost_why
    assert all(np.all(np.isfinite(x)) for x in rows)
    if isinstance(cascade.position, position.LinearController):
        # it has neither an integral nor a feedforward. At rest (k - s) e = s r, with the stiffness k = b K(0) and the
        # negative stiffness s of the linearised mechanics; the error of a growing reference lags behind that
        mechanics = linear_mechanics(MODEL)
        k = mechanics.b * cascade.position.realisation.response([1e-3]).ravel()[0].real
        at_rest = mechanics.s / (k - mechanics.s) * rows.r[-1]
        assert 0.9 * at_rest < np.max(np.abs(rows.e_z)) < at_rest
        return
    # from rest the reference runs away at 31 mm/s: 0.2 mm at most is lost in reaching, 0.1 mm is left at 60 ms,
    # when the reference is at 1.7 mm
    assert np.max(np.abs(rows.e_z)) < 2e-4
    assert np.max(np.abs(rows.e_z[-100:])) < 1e-4


# --- the paper's identities, at random points ---


def samples(n=200, seed=5):
    """Random z, z_dot, i, i_ref, r, r_dot, r_ddot, v-state in the ranges of the paper's figures."""
    scale = np.array([3e-3, 0.05, 0.1, 0.1, 2.5e-3, 0.03, 0.4, 1.0])
    return np.random.default_rng(seed).uniform(-1, 1, (n, 8)) * scale


def close(a, b, size):
    """Check equality up to the rounding of terms of the given size: a dozen operations, each at most 1e-14."""
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * size)


# law: its sliding variable from e, e', and its state x
MANIFOLDS = {
    position.SlidingMode(): lambda law, e, e_dot, x: e_dot + law.c * e,
    position.SuperTwisting(): lambda law, e, e_dot, x: e_dot + law.c * e,
    position.IntegralSlidingMode(): lambda law, e, e_dot, x: e_dot + law.c * e + law.c_int * x,  # Eq. (12)
    position.UtkinSlidingMode(): lambda law, e, e_dot, x: e_dot + law.k_d * e + x,
}


@pytest.mark.parametrize("law", MANIFOLDS, ids=lambda x: type(x).__name__)
def test_equation_5_sets_the_rate_of_sigma(law):
    # by the chain rule, with v = v_star and a disturbance q: what is left is the law's own robust term
    of, q = MANIFOLDS[law], 0.7
    for z, z_dot, i, _, r, r_dot, r_ddot, w in samples():
        motion, reference = Measurement(z, z_dot, i), Reference(r, r_dot, r_ddot)
        v_star, x_dot = law(MODEL, (motion, reference), w if has_state(law) else ())
        e, e_dot, e_ddot = z - r, z_dot - r_dot, 2 * MODEL.k_z / MODEL.m * z + MODEL.a * v_star - MODEL.g + q - r_ddot
        sigma = of(law, e, e_dot, w)
        if isinstance(law, position.SuperTwisting):
            robust, x_dot = w - law.k_1 * sigma / (sigma**2 + 1 / law.p**2) ** 0.25, 0.0
        else:
            robust = -law.k * 2 / np.pi * np.arctan(law.p * sigma)
        close(of(law, e_dot, e_ddot, x_dot if has_state(law) else 0.0), robust + q, 100.0)
        if isinstance(law, (position.SlidingMode, position.SuperTwisting)):
            np.testing.assert_allclose(law.sigma(motion, reference), sigma, rtol=1e-12, atol=1e-16)


def test_linearised_inversion_is_exact_at_the_origin_and_without_a_force():
    law, force = inversion.Linearised(), lambda z, v: float(law.inverse(MODEL, z, v))
    for z in (-3e-3, 0.0, 2e-3):  # no force: i = -i_0 z/s_0 gives both gaps the same ratio of current to gap
        assert force(z, 0.0) == pytest.approx(-MODEL.i_0 * z / MODEL.s_0, rel=1e-12)
        close(MODEL.v(z, force(z, 0.0)), 0.0, 1e4)
    close(MODEL.v(0.0, force(0.0, 3e3)), 3e3, 1e4)  # v(0, i) is linear in i
    # elsewhere the error is of third order: eight times as large at twice z and v_star
    errors = [float(MODEL.v(k * 1e-5, force(k * 1e-5, k * 10.0)) - k * 10.0) for k in (1, 2)]
    assert errors[1] / errors[0] == pytest.approx(8, rel=0.01)


@pytest.mark.parametrize("watch", [observer.Direct(), observer.Complementary()], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("law", [position.SlidingMode(), position.SuperTwisting()], ids=lambda x: type(x).__name__)
def test_the_rates_of_the_demand_are_derivatives_along_the_nominal_solution(watch, law):
    cascade, reference = Cascade(watch, law), Sine(2.5e-3, 2.0)

    @jax.jit
    def demand(s, x):
        """Return the demand after s seconds along the straight line through x.

        Along this line, time, motion and states of the laws change at their rates.
        """
        motion = Measurement(x[0], x[1], x[2])
        state = cascade.init(motion)._replace(
            observer=() if not has_state(watch) else x[3], position=() if not has_state(law) else x[7]
        )
        t = 0.1 + 30 * jnp.abs(x[4])
        _, _, rates, _ = cascade.demand(motion, state, Sample(reference_at(reference, t)))
        seen = motion.z if not has_state(watch) else x[3]
        moved = Measurement(x[0] + s * x[1], x[1] + s * MODEL.z_ddot(seen, x[2]), x[2])
        later = jax.tree.map(
            lambda a, b: a + s * b, state, state._replace(observer=rates.observer, position=rates.position)
        )
        return cascade.demand(moved, later, Sample(reference_at(reference, t + s)))[0]

    h = 1e-8
    for x in samples(50):
        x[3] *= 3e-2  # the observer's estimate: millimetres
        here, after, before = demand(0.0, x), demand(h, x), demand(-h, x)
        difference = (after.v_star - before.v_star) / (2 * h)
        # rounding: eps |v_star| / h = 2e-16 * 1e3 / 1e-8 = 2e-5; truncation (h p sigma_dot)^2: 3e-8 relative, measured
        np.testing.assert_allclose(here.v_star_rate, difference, rtol=1e-6, atol=1e-3)
        np.testing.assert_allclose(here.z_rate, (after.z - before.z) / (2 * h), rtol=1e-6, atol=1e-8)


def test_pi_integral_is_bounded_while_the_supply_saturates():
    law = current.ProportionalIntegral()
    measured, u_max, errors = Measurement(0.0, 0.0, 0.0), 100.0, np.array([-0.3, -0.01, 0.01, 0.3])

    def rate(x, error):
        return law(MODEL, CurrentInputs(measured, CurrentDemand(error, 0.0), u_max), x)[1]

    for error in errors:
        # saturated, x' = k_int error + k_aw (+-u_max - k_p error - x): a stable line with one zero
        rest = law.k_int / law.k_aw * error + np.sign(error) * u_max - law.k_p * error
        assert abs(rest + law.k_p * error) > u_max
        np.testing.assert_allclose(rate(rest, error), 0, atol=1e-12 * law.k_int * abs(error))
        np.testing.assert_allclose(jax.grad(rate)(rest, error), -law.k_aw, rtol=1e-12)
        np.testing.assert_allclose(rate(0.0, error) / rest, law.k_aw, rtol=1e-9)
    # unsaturated there is no leak
    assert jax.grad(rate)(0.0, 1e-6) == 0
    np.testing.assert_allclose(rate(0.0, 1e-6), law.k_int * 1e-6, rtol=1e-14)


def test_the_error_of_the_complementary_observer_decays_at_rate_l_and_integrates_velocity_noise():
    law = observer.Complementary(l=7.0)
    z, z_dot, i = 1e-3, 0.02, 0.05
    for error in (-1e-3, 0.0, 2e-4):
        estimate, rate = law(MODEL, Measurement(z, z_dot, i), jnp.asarray(z + error))
        assert estimate == Measurement(z + error, z_dot, i)
        np.testing.assert_allclose(rate - z_dot, -law.l * error, rtol=1e-12, atol=1e-16)
    by = jax.jacfwd(lambda m: law(MODEL, m, jnp.asarray(0.0))[1])(Measurement(z, z_dot, i))
    assert by == Measurement(7.0, 1.0, 0.0)
    assert law.init(MODEL, Measurement(z, z_dot, i)) == z
    assert observer.Complementary(z_hat=1e-4).init(MODEL, Measurement(z, z_dot, i)) == 1e-4


def test_pid_places_the_poles_of_the_error_on_the_nominal_plant():
    # v = v_star: e'' = -k_p e - k_d d - x, d' = w_f (e' - d), x' = k_int e, whatever the plant
    law, heavy = position.PID(), dataclasses.replace(MODEL, m=3 * MODEL.m, g=1.0, s_0=2 * MODEL.s_0)
    for model in (MODEL, heavy):
        for z, z_dot, _, d, r, r_dot, r_ddot, x in samples(50):
            motion, reference = Measurement(z, z_dot, None), Reference(r, r_dot, r_ddot)
            state = PIDState(d, x)
            v_star, _ = law(model, (motion._replace(i=0.0), reference), state)
            i = model.current_for(z, v_star)
            v_star, rate = law(model, (motion._replace(i=i), reference), state)
            e_ddot = 2 * model.k_z / model.m * z + model.a * v_star - model.g - r_ddot
            close(e_ddot, -law.k_p * (z - r) - law.k_d * d - x, 100.0)
            close(rate.rate, law.w_f * (z_dot - r_dot - d), 1e4)
            # if the force cannot be reached, the current gives another one, and the anti-windup adds this difference
            reached = law.k_aw * model.a * (v_star - model.v(z, i))
            close(rate.integral, law.k_int * (z - r) + reached, 1e6)
            close(law.sigma(motion, reference), z_dot - r_dot + law.k_p / law.k_d * (z - r), 1.0)


def test_the_integral_of_a_pid_does_not_wind_up_while_the_current_is_limited():
    # the current stands still at i: x settles where v_star = v(z, i) - k_int e/(k_aw a), and does not run away
    law, z, i = position.PID(), 1e-4, -0.05
    inputs = Measurement(z, 0.0, i), Reference(0.0, 0.0, 0.0)
    state, step = law.init(MODEL), jax.jit(lambda state: law.step(MODEL, inputs, state, 1e-3))
    for _ in range(4000):
        v_star, state = step(state)
    assert float(MODEL.a * (v_star - MODEL.v(z, i))) == pytest.approx(-law.k_int * z / law.k_aw, rel=1e-9)


def test_a_pid_steps_its_filter_and_its_anti_windup_by_backward_euler():
    law, T = position.PID(w_f=3e4, k_aw=2e4), 1e-4
    for z, z_dot, i, d, r, r_dot, r_ddot, x in samples(50):
        inputs = Measurement(z, z_dot, i), Reference(r, r_dot, r_ddot)
        assert law.begin(MODEL, inputs) == PIDState(z_dot - r_dot, 0.0)
        v_star, after = law.step(MODEL, inputs, PIDState(d, x), T)
        close(after.rate, d + T * law.w_f * (z_dot - r_dot - after.rate), 1.0)
        demanded = law(MODEL, inputs, after)
        close(after.integral, x + T * demanded[1].integral, 1e5)
        close(v_star, law(MODEL, inputs, after._replace(integral=x))[0], 1e4)
    # a slow filter and a slow anti-windup: the step of the continuous law
    slow, T = position.PID(w_f=10.0, k_aw=1.0), 1e-7
    state = PIDState(jnp.asarray(0.01), jnp.asarray(0.2))
    inputs = Measurement(1e-4, 0.02, 0.01), Reference(0.0, 0.0, 0.0)
    (v_0, rate), (v_1, after) = slow(MODEL, inputs, state), slow.step(MODEL, inputs, state, T)
    np.testing.assert_allclose(v_1, v_0, rtol=1e-5)
    for x, y, d in zip(state, after, rate, strict=True):
        np.testing.assert_allclose((y - x) / T, d, rtol=1e-5)


@pytest.mark.parametrize("p", [0.01, 25.0, 1e3])
@pytest.mark.parametrize("stage", ["position", "inversion", "current"])
def test_slope_of_the_sliding_laws_is_their_steepest_rate(stage, p):
    if stage == "position":
        law = position.SlidingMode(p=p)
        steepest = abs(jax.grad(lambda s: law.k * smooth_sign(s, p))(0.0))
        steepest = max(steepest, law.c)
    elif stage == "inversion":
        law = inversion.Adaptive(p=p)
        # d(i_ref')/d(i_ref) at v_tilde = 0
        steepest = -jax.grad(lambda i: law(MODEL, ForceDemand(0.0, 0.0, 0.0, 0.0), i)[1])(0.0)
    else:
        law = current.SlidingMode(p=p)

        def e_dot(i):
            u, _ = law(MODEL, CurrentInputs(Measurement(0.0, 0.0, i), CurrentDemand(0.0, 0.0), np.inf), ())
            return MODEL.i_dot(0.0, 0.0, i, u)

        steepest = -jax.grad(e_dot)(0.0)
    np.testing.assert_allclose(law.slope(MODEL), steepest, rtol=1e-12)
