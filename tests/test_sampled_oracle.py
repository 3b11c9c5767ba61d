"""The independent simulator of the sampled loop, checked by itself: hand-computed cases, limits, conservation."""

import math

import numpy as np
import pytest
from sampled_oracle import Lumped, TwoCoil, World, relax, sgn, simulate


def random_cases(size):
    """w of both signs, h and p over many decades."""
    rng = np.random.default_rng(1)
    decades, signs = rng.uniform([-9, -9, -6], [6, 6, 9], (size, 3)), rng.choice([-1, 1], size)
    return [(sign * 10**a, 10**b, 10**c) for sign, (a, b, c) in zip(signs, decades, strict=True)]


@pytest.mark.parametrize("infinite", [False, True])
def test_relax_solves_its_equation(infinite):
    for w, h, p in random_cases(3000):
        y = relax(w, h, math.inf if infinite else p)
        assert y * w >= 0
        assert abs(y) <= abs(w)
        assert relax(-w, h, p) == -relax(w, h, p)
        if infinite:  # outside the band w moves by h; inside it comes to rest
            assert y == (math.copysign(abs(w) - h, w) if abs(w) > h else 0.0)
        else:  # a few roundings of the largest term, carried through the slope 1 + h sgn_p' by the y next to it
            slope = 1 + h * 2 / math.pi * p / (1 + (p * y) ** 2)
            assert abs(y + h * sgn(y, p) - w) <= 4 * np.finfo(float).eps * (abs(w) + h + slope * abs(y))


def test_two_coils_conserve_energy_and_flux():
    """The energy is kinetic, of the spring, of the weight, and kappa/4 (i_1^2/(s_0 - z) + i_2^2/(s_0 + z)).

    The power is that of the voltages minus the copper loss.
    """
    plant = TwoCoil(World())
    body, rng = plant.body, np.random.default_rng(2)
    for z, z_dot, i_1, i_2, u in rng.uniform(-1, 1, (50, 5)) * [4e-3, 1.0, 1.0, 1.0, 200.0]:
        rates = plant.rates([z, z_dot, i_1, i_2], u)
        upper, lower, bias = body.s_0 - z, body.s_0 + z, body.R * body.i_0
        gradient = [
            -2 * body.k_z * z + body.m * body.g + body.kappa / 4 * ((i_1 / upper) ** 2 - (i_2 / lower) ** 2),
            body.m * z_dot,
            body.kappa / 2 * i_1 / upper,
            body.kappa / 2 * i_2 / lower,
        ]
        power = (bias + u) * i_1 + (bias - u) * i_2 - body.R * (i_1**2 + i_2**2)
        terms = np.multiply(gradient, rates)
        assert abs(terms.sum() - power) < 1e-12 * np.abs(terms).max()
        for current, rate, gap, gap_dot, voltage in (
            (i_1, rates[2], upper, -z_dot, bias + u), (i_2, rates[3], lower, z_dot, bias - u)
        ):  # fmt: skip
            flux_dot = body.kappa / 2 * (rate / gap - current * gap_dot / gap**2)
            assert flux_dot == pytest.approx(voltage - body.R * current, rel=1e-11, abs=1e-9)


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 1.5, 2.0])
def test_the_voltage_switches_after_the_delay(delay, fast):
    """A single coil under u_n = k_p (i_ref - i_n). Between switchings i decays to u/R with the rate 2 s_0 R / kappa."""
    k_p, i_ref, T = 1e5, 0.01, 1e-4
    world = World(
        plant={"m": 1e12, "g": 0.0, "k_z": 0.0}, delay=delay, predict=False, period=T,
        position=("sliding-mode", {"c": 0.0, "k": 0.0, "p": 25.0}),
        inversion=("adaptive", {"gamma": 0.0, "p": 25.0, "i_ref": i_ref}),
        current=("pi", {"k_p": k_p, "k_int": 0.0, "k_aw": 0.0}),
    )  # fmt: skip
    run = simulate(world, 60, fast=fast)
    body = Lumped(world).body
    i, given = 0.0, [0.0, 0.0, 0.0]  # the last voltage is u_n
    first, parts = {0.0: (1, [1.0]), 0.5: (2, [0.5, 0.5]), 1.0: (2, [1.0]), 1.5: (3, [0.5, 0.5]), 2.0: (3, [1.0])}[
        delay
    ]
    for n in range(60):
        given.append(k_p * (i_ref - i))
        assert run.i[n] == pytest.approx(i, abs=1e-13)
        assert run.u[n] == pytest.approx(given[-1], abs=1e-8)
        for k, part in enumerate(parts):
            decay = math.exp(-2 * body.s_0 * body.R / body.kappa * part * T)
            i = decay * i + (1 - decay) * given[-first + k] / body.R


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("T", [1e-4, 3.3e-3])
def test_a_touchdown_between_samples_ends_the_run(T, fast):
    """Free fall from z = 0 to -0.9 s_0 without magnetic field and voltage takes sqrt(2 0.9 s_0 / g)."""
    world = World(
        plant={"A": 1e-15, "R": 0.0, "k_z": 0.0}, period=T, predict=False,
        position=("sliding-mode", {"c": 0.0, "k": 0.0, "p": 1.0}),
        inversion=("adaptive", {"gamma": 0.0, "p": 25.0}), current=("sliding-mode", {"k_i": 0.0, "p": 25.0}),
    )  # fmt: skip
    run = simulate(world, math.ceil(0.05 / T), fast=fast)
    assert run.lost_at == pytest.approx(math.sqrt(2 * 0.9 * 5e-3 / 9.81), rel=1e-12)
    assert np.array_equal(np.isfinite(run.z), run.t < run.lost_at)
