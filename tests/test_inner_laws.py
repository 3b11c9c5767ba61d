"""The dead-beat current law and the adaptive inversion with feed-forward, against Eqs. (2) and (8)."""

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ambjax.control.stages import CurrentDemand, CurrentInputs, ForceDemand
from ambjax.laws import current, inversion
from ambjax.numerics.smooth import smooth_sign
from ambjax.plants import Plant
from ambjax.world.sensor import Measurement

MODEL = Plant()
RIG = Plant(1.64, 0.0, 1.2566e-6, 208.0, 2.68e-4, 5e-4, 2.5, 1.0)


def points(model, count=12):
    """Random z, z_dot, i, i_ref and i_ref'."""
    scale = np.array([0.4 * model.s_0, 20 * model.s_0, 0.4 * model.i_0, 0.4 * model.i_0, 50 * model.i_0])
    return np.random.default_rng(2).uniform(-1, 1, (count, 5)) * scale


@pytest.mark.parametrize("share", [1.0, 0.4])
@pytest.mark.parametrize(
    ("model", "T"),
    [(MODEL, 1e-4), (RIG, 5e-5), (RIG, 5e-3), (Plant(R=0.0), 1e-4)],
    ids=["paper", "rig", "slow", "no resistance"],
)
def test_dead_beat_removes_its_share_of_the_error_in_one_sample(model, T, share):
    law = current.DeadBeat(share=share)
    for z, z_dot, i, i_ref, i_ref_dot in points(model):
        inputs = CurrentInputs(Measurement(z, z_dot, i), CurrentDemand(i_ref, i_ref_dot), np.inf)
        u, _ = law.step(model, inputs, (), T)
        lower = model.s_0 + z

        def i_dot(t, x, u=float(u), lower=lower, z_dot=z_dot):  # Eq. (2) as printed, at this z and z_dot
            return 2 * z_dot * x / lower + 2 * lower / model.kappa * (u - model.R * x)

        reached = solve_ivp(i_dot, (0, T), [i], rtol=1e-11, atol=1e-14).y[0, -1]
        wanted = i_ref + T * i_ref_dot + (1 - share) * (i - i_ref)
        # the tolerance of the solver
        np.testing.assert_allclose(reached, wanted, rtol=0, atol=1e-8 * model.i_0)


def test_dead_beat_in_continuous_time_has_the_error_dynamics_of_one_pole():
    law = current.DeadBeat(w=700.0)
    for z, z_dot, i, i_ref, i_ref_dot in points(MODEL):
        inputs = CurrentInputs(Measurement(z, z_dot, i), CurrentDemand(i_ref, i_ref_dot), np.inf)
        u, _ = law(MODEL, inputs, ())
        e_dot = MODEL.i_dot(z, z_dot, i, u) - i_ref_dot
        np.testing.assert_allclose(e_dot, -700.0 * (i - i_ref), rtol=1e-10, atol=1e-10)


def test_feed_forward_leaves_only_the_sign_in_equation_8():
    law = inversion.FeedForwardAdaptive()
    for z, z_dot, i_ref, force, rate in points(MODEL, 50):
        v_star, v_star_dot = 3e3 * force, 1e3 * rate
        demand, moved = law(MODEL, ForceDemand(z, z_dot, v_star, v_star_dot), i_ref)
        assert demand == (i_ref, moved)
        w, w_dot = jax.jvp(lambda v, z, i: v - MODEL.v(z, i), (v_star, z, i_ref), (v_star_dot, z_dot, float(moved)))
        # rounding of terms of some 1e5 A^2/m^2/s
        np.testing.assert_allclose(w_dot, -law.gamma * smooth_sign(w, law.p), atol=1e-7)


def test_sampled_feed_forward_reaches_the_force_of_the_next_sample():
    law, T = inversion.FeedForwardAdaptive(gamma=1e9, p=None), 1e-4
    for z, z_dot, i_ref, force, rate in points(MODEL, 50):
        v_star, v_star_dot = 3e3 * force, 1e3 * rate
        demand, after = law.step(MODEL, ForceDemand(z, z_dot, v_star, v_star_dot), i_ref, T)
        # |w| < gamma T: the whole error is removed, and the next sample's force is met
        assert abs(v_star - MODEL.v(z, i_ref)) < law.gamma * T
        np.testing.assert_allclose(MODEL.v(z + T * z_dot, after), v_star + T * v_star_dot, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(i_ref + T * demand.i_ref_dot, after, atol=1e-14)
