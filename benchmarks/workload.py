"""The workload of every ensemble benchmark, and a second implementation of its right-hand side for the peers.

The paper's tracking scenario with the disturbance as scaled force and smooth gains (inversion gamma = 1e9, p = 25e-6,
the others as in the paper). Members differ in the initial position. RK4 takes steps of 1e-5 s, ten steps a sample. The
pulse acts in the middle of the horizon for every length. The fold is the largest |z - r| of each member.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax import Cascade, Clock, Initial, Scenario, paper, rollout
from ambjax.ensemble import run_ensemble
from ambjax.laws import inversion
from ambjax.plants import Plant
from ambjax.sensors import Sensor
from ambjax.signals import Pulse
from ambjax.simulation.folds import Peak
from ambjax.solvers import RK4

GAMMA, P_V = 1e9, 25e-6
PERIOD, SUBSTEPS = 1e-4, 10
NOISE = Sensor(std=1e-6, std_z_dot=1e-4, std_i=1e-4)
# Largest initial distance from the centre, m.
SPREAD = 1e-4
FOLD = Peak("e_z")


class Workload(NamedTuple):
    """One ensemble: the arguments of `run_ensemble`."""

    cascade: Cascade
    scenario: Scenario
    clock: Clock

    @property
    def members(self) -> int:
        return np.size(self.scenario.initial.z)

    @property
    def steps(self) -> int:
        """Return the number of RK4 steps of one member."""
        return self.clock.samples * substeps(self.clock)

    @property
    def pulse(self) -> tuple[int, int]:
        """Return the first sample with the pulse and the first one after it."""
        force = vars(self.scenario.q_v)
        return round(force["start"] / PERIOD), round(force["stop"] / PERIOD)

    def lasting(self, samples: int) -> "Workload":
        """Return the workload, pulse included, over another horizon."""
        return self._replace(clock=dataclasses.replace(self.clock, samples=samples))

    def stepping(self, method: Any, samples: int = 1) -> "Workload":
        """Return a noise-free workload with another method and each `samples` samples merged into one."""
        period = self.clock.sample_period * samples
        return self._replace(clock=Clock(self.clock.samples // samples, period, method))

    def few(self, members: int) -> "Workload":
        """Return a workload with some of the members, spread evenly."""
        chosen = np.linspace(0, self.members - 1, members).round().astype(int)
        initial = dataclasses.replace(self.scenario.initial, z=jnp.asarray(self.scenario.initial.z)[chosen])
        member = np.asarray(self.scenario.member)[chosen]
        return self._replace(scenario=dataclasses.replace(self.scenario, initial=initial, member=member))


def substeps(clock: Clock) -> int:
    """Return the steps per sample, for a method that declares them."""
    method: Any = clock.method
    return method.substeps


def workload(members: int, samples: int, *, noise: bool = False) -> Workload:
    cascade = dataclasses.replace(paper.cascade("repaired"), inversion=inversion.Adaptive(GAMMA, P_V))
    start, stop = round(0.4 * samples), round(0.65 * samples)
    scenario = dataclasses.replace(
        paper.scenario("tracking", "repaired"),
        q_v=Pulse(1.0, start * PERIOD, stop * PERIOD),
        sensor=NOISE if noise else None,
        initial=Initial(z=jnp.asarray(SPREAD * ((2 * np.arange(members) + 1) / members - 1))),
        member=jnp.arange(members),
    )
    return Workload(cascade, scenario, Clock(samples, PERIOD, RK4(SUBSTEPS)))


def by_ambjax(work: Workload, threads: int = 1, **options: Any) -> Any:
    """Return the largest |z - r| of each member by ambjax: the ensemble engine, or `rollout` for one member."""
    if work.members > 1:
        return run_ensemble(*work, fold=FOLD, threads=threads, **options).metrics
    first = float(np.ravel(work.scenario.initial.z)[0])
    alone = dataclasses.replace(work.scenario, initial=Initial(z=first), member=0)
    return rollout(work.cascade, alone, work.clock, fold=FOLD, record_every=0).metrics


def right_side(gamma: float, p_v: float, xp: Any) -> Callable[..., Any]:
    """Return the right-hand side f(t, (z, z_dot, i, i_ref), q) -> rates of the noise-free closed loop.

    q: disturbance as scaled force, A^2/m^2. `xp`: `math`, `numpy` or `jax.numpy`; Numba can compile f if it is `math`.
    """
    sin, cos, atan, pi = xp.sin, xp.cos, xp.atan, math.pi
    plant = Plant()
    m, k_z, s_0, i_0, g, R = plant.m, plant.k_z, plant.s_0, plant.i_0, plant.g, plant.R
    kappa, a, w = plant.kappa, plant.a, 4 * math.pi
    c, k, p, k_i = 17.0, 25.0, 25.0, 152.0

    def f(t: Any, y: Any, q: Any) -> Any:
        z, z_dot, i, i_ref = y[0], y[1], y[2], y[3]
        sine, cosine = sin(w * t), cos(w * t)
        r, r_dot, r_ddot = 2.5e-3 * sine, 2.5e-3 * w * cosine, -2.5e-3 * w * w * sine
        sigma = z_dot - r_dot + c * (z - r)
        robust = k * 2 / pi * atan(p * sigma)
        v_star = (-2 * k_z / m * z - c * (z_dot - r_dot) + r_ddot + g - robust) / a
        up, low = s_0 - z, s_0 + z
        v_ref = ((i_0 + i_ref) / up) ** 2 - ((i_0 - i_ref) / low) ** 2
        v = ((i_0 + i) / up) ** 2 - ((i_0 - i) / low) ** 2
        slope = 2 * (i_0 + i_ref) / up**2 + 2 * (i_0 - i_ref) / low**2
        i_ref_dot = gamma * 2 / pi * atan(p_v * (v_star - v_ref)) / slope
        e_law = -k_i * 2 / pi * atan(p * (i - i_ref))
        u = kappa / (2 * low) * (-2 * z_dot / low * i + i_ref_dot + e_law) + R * i
        i_dot = 2 * z_dot / low * i + 2 * low / kappa * (u - R * i)
        return z_dot, 2 * k_z / m * z + a * v - g + a * q, i_dot, i_ref_dot

    return f
