"""Default gains: those of the paper for its plant, and for every other plant a loop in zone A."""

import dataclasses
import pathlib
import tomllib

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, sensitivity, simulate
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.reader import case_from
from ambjax.control.base import default_law
from ambjax.control.sampling import Sampling
from ambjax.control.stages import CurrentDemand, CurrentInputs
from ambjax.laws import current, inversion, position
from ambjax.plants import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

BLOWER = (pathlib.Path(__file__).parent / "cases" / "machines" / "blower.toml").read_text()
RIG = Plant(1.64, 0.0, 1.2566e-6, 208.0, 2.68e-4, 5e-4, 2.5, 1.0)
FAN = Plant(0.08, -300.0, 1.2566e-6, 400.0, 5e-5, 4e-4, 0.3, 9.0)
MODELS = pytest.mark.parametrize("model", [RIG, FAN], ids=["rig", "fan"])
STILL = Reference(0.0, 0.0, 0.0)
SIGNS = {
    "position": (position.SlidingMode, position.IntegralSlidingMode, position.SuperTwisting),
    "inversion": (inversion.Adaptive, inversion.FeedForwardAdaptive),
    "current": (current.SlidingMode,),
}


@pytest.mark.parametrize("sampling", [None, Sampling(1e-4, 1.0, True), Sampling(1e-3, 0.0, False)])
def test_the_plant_of_table_1_has_the_gains_of_table_2(sampling):
    for kinds in SIGNS.values():
        for kind in kinds:
            assert default_law(kind, Plant(), sampling) == kind()
    paper = Cascade()
    assert (paper.position.c, paper.position.k, paper.inversion.gamma, paper.current.k_i) == (17.0, 25.0, 7.5e4, 152.0)
    assert paper.position.p == paper.inversion.p == paper.current.p == 25.0


def test_the_paper_s_inner_gains_belong_to_its_position_law():
    """Its gamma is too small for the demand of a faster law on the same plant."""
    for kind, law in KINDS["position"].items():
        if kind == "linear":
            continue
        laws = case_from({"controller": {"position": {"kind": kind}}}).cascade
        usual = Cascade()
        if law in SIGNS["position"]:
            assert (laws.inversion, laws.current) == (usual.inversion, usual.current)
        else:
            assert laws.inversion.gamma > 50 * usual.inversion.gamma
            assert laws.current.k_i > 2 * usual.current.k_i


# poles of the error, as multiples of the pole of the magnets
POLES = {
    position.SlidingMode: [-1, -1],
    position.IntegralSlidingMode: [-1, -0.5, -0.5],
    position.SuperTwisting: [-1, -0.5, -0.5],
    position.FeedbackLinearisation: [-1, -1],
    position.PID: [-1, -0.5, -0.5],
}


@MODELS
@pytest.mark.parametrize("kind", POLES, ids=lambda kind: kind.__name__)
def test_the_default_gains_place_the_poles_of_the_error_at_the_pole_of_the_magnets(kind, model):
    """The eigenvalues of the law's derivative, with an exact force: z_ddot = 2 k_z z/m + a v_star - g."""
    law = default_law(kind, model)
    if kind is position.PID:  # an ideal derivative, and no anti-windup: the force is that demanded
        law = dataclasses.replace(law, w_f=np.asarray(1e7 * model.pole), k_aw=np.zeros(()))
    state = jax.tree.map(jnp.asarray, law.init(model))
    flat, back = jax.flatten_util.ravel_pytree((jnp.zeros(()), jnp.zeros(()), state))

    def rates(x):
        z, z_dot, state = back(x)
        v_star, rate = law(model, (Measurement(z, z_dot, 0.0), STILL), state)
        return jax.flatten_util.ravel_pytree((z_dot, 2 * model.k_z / model.m * z + model.a * v_star - model.g, rate))[0]

    poles = np.linalg.eigvals(jax.jacfwd(rates)(flat)) / float(model.pole)
    found, wanted = np.sort_complex(poles[np.abs(poles) < 1e3]), np.array(POLES[kind], float)
    # a double pole amplifies rounding, and the lag 1e-7/w of the derivative, to their square roots
    np.testing.assert_allclose(np.poly(found), np.poly(wanted), rtol=1e-6, atol=1e-6)


@MODELS
def test_the_default_gamma_is_delta_1_of_a_rotor_that_crosses_the_gap_in_the_time_of_the_pole(model):
    needed = abs(float(jax.grad(model.v)(0.0, 0.0))) * float(model.pole) * model.s_0
    for kind in SIGNS["inversion"]:
        assert float(default_law(kind, model).gamma) == pytest.approx(needed, rel=1e-12)


@MODELS
@pytest.mark.parametrize("period", [None, 1e-5, 4e-4])  # a quarter of the sampling rate: above and below 10 w
def test_the_default_current_loop_has_ten_times_the_pole_but_not_more_than_a_quarter_of_the_sampling_rate(
    model, period
):
    law = default_law(current.SlidingMode, model, None if period is None else Sampling(period, 1.0, True))

    def i_dot(i):
        motion = Measurement(0.0, 0.0, i)
        u, _ = law(model, CurrentInputs(motion, CurrentDemand(0.0, 0.0), jnp.inf), ())
        return model.i_dot(0.0, 0.0, i, u)

    rate = 10 * float(model.pole)
    wanted = rate if period is None else min(rate, 0.25 / period)
    assert -float(jax.grad(i_dot)(0.0)) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 2.0, 3.4])
def test_default_dead_beat_control_does_not_oscillate(delay):
    """The roots of x(n+1) = x(n) - share x(n - delay), interpolated between samples, are real or decay faster."""
    share = default_law(current.DeadBeat, RIG, Sampling(5e-5, delay, True)).share
    whole, rest = int(delay), delay - int(delay)
    polynomial = np.array([1.0, -1.0, *[0.0] * (whole + 1)])  # z^n (z - 1) + share z^(n - delay)
    polynomial[1 + whole] += share * (1 - rest)
    polynomial[2 + whole] += share * rest
    roots = np.roots(polynomial)
    slowest = roots[np.abs(roots) > np.abs(roots).max() - 1e-3]
    assert np.abs(roots).max() < 1
    assert np.all(np.abs(slowest.imag) < 2e-2)  # the grid of `slope_limits`: a double root to the root of its step


@pytest.mark.parametrize("kind", [kind for kinds in KINDS.values() for kind in kinds.values()])
def test_default_gains_have_the_scales_of_the_plant(kind):
    """Similar machines have similar gains: with the units of length, time and current of the plant, equal numbers.

    The second plant is the first in other units: lengths times 3, times halved, currents times 0.7.
    """
    length, time, ampere = 3.0, 0.5, 0.7
    kilogram = 2.0
    volt = kilogram * length**2 / time**3 / ampere
    scale = {
        "m": kilogram, "k_z": kilogram / time**2, "mu_0": kilogram * length / time**2 / ampere**2, "A": length**2,
        "s_0": length, "i_0": ampere, "R": volt / ampere, "g": length / time**2, "n": 1.0,
    }  # fmt: skip
    other = Plant(**{name: getattr(RIG, name) * factor for name, factor in scale.items()})
    units = {"m": length, "s": time, "A": ampere, "V": volt, "1": 1.0}
    ours = default_law(kind, RIG, Sampling(5e-5, 1.0, True))
    theirs = default_law(kind, other, Sampling(5e-5 * time, 1.0, True))
    for field in dataclasses.fields(kind):
        if not field.metadata.get("steepness") and "steepness" not in field.metadata:
            continue
        if kind is position.LinearController:
            continue  # its matrices are in a file
        value, found = getattr(ours, field.name), getattr(theirs, field.name)
        if value is None:  # a filter that is off
            assert found is None
            continue
        # 1e-6: the solver of the Riccati equation of the linear laws
        assert float(found) == pytest.approx(float(value) * _size(field.metadata["unit"], units), rel=1e-6), field.name


def _size(unit, units):
    """Return the size of a unit such as "m^0.5/s^1.5" or "A s/m" in the scaled units."""
    size = 1.0
    for position_, part in enumerate(unit.split("/")):
        for word in part.split():
            name, _, power = word.partition("^")
            size *= units[name] ** ((1 if position_ == 0 else -1) * float(power or 1))
    return size


LAWS = [
    ("sliding-mode", "adaptive", "sliding-mode"),
    ("integral-sliding-mode", "adaptive", "pi"),
    ("super-twisting", "adaptive-feed-forward", "sliding-mode"),
    ("utkin-sliding-mode", "adaptive", "dead-beat"),
    ("terminal-sliding-mode", "adaptive", "sliding-mode"),
    ("pid", "adaptive", "sliding-mode"),
    ("feedback-linearisation", "adaptive-feed-forward", "pi"),
]


@pytest.mark.parametrize(
    "laws",
    # the benchmark of the default gains contains every structure
    [pytest.param(laws, marks=pytest.mark.slow if laws[0] == "pid" else pytest.mark.thorough) for laws in LAWS],
    ids="/".join,
)
def test_untuned_laws_levitate_a_machine_that_is_not_the_papers_in_zone_a(laws):
    raw = tomllib.loads(BLOWER)
    stages = zip(("position", "inversion", "current"), laws, strict=True)
    raw["controller"] |= {stage: {"kind": kind} for stage, kind in stages}
    case = case_from(raw)
    run = simulate(case)
    assert not run.lost
    assert sensitivity(case).zone == "A"
