"""A custom plant and a custom law, defined in this file: simulated and checked.

The plant has a coil with its own current on each side; the law a boundary layer in place of a smoothed sign, and gains
of its own names. Nothing in the package knows either.
"""

import collections
import dataclasses
import itertools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ambjax import Cascade, Clock, Initial, Scenario, rollout
from ambjax.extend import Bearing, PositionLaw, Requirement, Signals, force_for, gain, leaf, record, sliding_variable
from ambjax.laws import inversion
from ambjax.sensors import Measurement
from ambjax.signals import Pulse, Sine
from ambjax.simulation.loop import ClosedLoop
from ambjax.solvers import AdaptiveRodas3
from ambjax.theorem.conditions import check

# Displacement (m), velocity (m/s), and the current of the upper and the lower coil (A).
Coils = collections.namedtuple("Coils", ["z", "z_dot", "i_1", "i_2"])


@record
class TwoCoils(Bearing):
    """Each coil has its own circuit. The resistance of the lower one is larger by a share `skew`."""

    skew: Any = leaf(default=0.05, unit="1", at_least=-0.5, at_most=0.5, doc="excess of the lower coil's resistance")

    def start(self, measurement):
        z, z_dot, i = measurement
        return Coils(z, z_dot, self.i_0 + i, self.i_0 - i)

    def rates(self, state, u, q_z=0.0, q_i=0.0):
        upper, lower = self.gaps(state.z).inverses
        z_ddot = 2 * self.k_z / self.m * state.z + self.a * self.signals(state).v - self.g + q_z
        drop_1, drop_2 = self.R * state.i_1, self.R * (1 + self.skew) * state.i_2
        i_1 = 2 / (upper * self.kappa) * (self.R * self.i_0 + u - drop_1) - state.i_1 * state.z_dot * upper + q_i
        i_2 = 2 / (lower * self.kappa) * (self.R * self.i_0 - u - drop_2) + state.i_2 * state.z_dot * lower - q_i
        return Coils(state.z_dot, z_ddot, i_1, i_2)

    def rest(self, state, z):
        return state._replace(z=z, z_dot=jnp.zeros_like(z))

    def scale(self):
        z, z_dot, i = self.sizes()
        return Coils(z, z_dot, i, i)

    def measurement(self, state):
        return Measurement(state.z, state.z_dot, (state.i_1 - state.i_2) / 2)

    def signals(self, state):
        upper, lower = self.gaps(state.z).inverses
        heat = self.R * (state.i_1**2 + (1 + self.skew) * state.i_2**2)
        return Signals((state.i_1 * upper) ** 2 - (state.i_2 * lower) ** 2, heat)


@record
class BoundaryLayer(PositionLaw):
    """sigma' = -rho tanh(sigma / width): a position law with gains of its own names."""

    decay: Any = gain(default=17.0, unit="1/s", doc="decay rate on the manifold")
    rho: Any = gain(default=25.0, unit="m/s^2", doc="reaching gain; above Q_z")
    width: Any = gain(default=0.05, unit="m/s", doc="width of the layer")
    requirement: ClassVar = Requirement("rho", "Q_z")

    def init(self, model):
        return ()

    def scale(self, model):
        return ()

    def slope(self, model):
        return jnp.maximum(self.rho / self.width, self.decay)

    def sigma(self, motion, reference):
        return sliding_variable(self.decay, motion, reference)

    def robust(self, sigma):
        return -self.rho * jnp.tanh(sigma / self.width)

    def __call__(self, model, inputs, state):
        motion, reference = inputs
        robust = self.robust(self.sigma(motion, reference))
        return force_for(self.decay, model, motion, reference, robust), ()


CASCADE = Cascade(position=BoundaryLayer(), inversion=inversion.Adaptive(1e9, 25e-6))
SCENARIO = Scenario(
    plant=TwoCoils(), reference=Sine(1e-3, 5.0), q_v=Pulse(0.5, 0.02, 0.04), initial=Initial(2e-4), u_max=400.0
)


CLOCK = Clock(600, 1e-4)
RHO = "controller.position.rho"


@pytest.mark.slow
def test_a_custom_law_and_plant_are_simulated():
    rows = rollout(CASCADE, SCENARIO, Clock(600, 1e-4, AdaptiveRodas3(1e-9))).trajectory.rows
    assert rows.alive.all()
    # the plant of two circuits written out once more, by another integrator, under the same laws
    p, loop = SCENARIO.plant, ClosedLoop(CASCADE, SCENARIO)
    start, tree = jax.tree.flatten(loop.start())

    @jax.jit
    def decided(t, x):
        _, rates, u = loop.command(loop.inputs(t), jax.tree.unflatten(tree, list(x)), loop.sensor_errors(0))
        return u, jnp.stack(jax.tree.leaves(rates)), loop.inputs(t).q_z

    def written(t, x):
        u, rates, q_z = map(np.asarray, decided(t, x))
        z, z_dot, i_1, i_2, *_ = x
        up, down, R, K = p.s_0 - z, p.s_0 + z, p.R, p.mu_0 * p.n**2 * p.A
        force = K / 4 * ((i_1 / up) ** 2 - (i_2 / down) ** 2)
        fall = (2 * p.k_z * z + force) / p.m - p.g + q_z
        i_1_dot = 2 * up / K * (R * p.i_0 + u - R * i_1) - i_1 * z_dot / up
        i_2_dot = 2 * down / K * (R * p.i_0 - u - 1.05 * R * i_2) + i_2 * z_dot / down
        return [z_dot, fall, i_1_dot, i_2_dot, *rates]

    ends = [0.0, 0.02, 0.04, 0.0599]  # the pulse jumps at these
    x = np.array([float(leaf) for leaf in start])
    for begin, end in itertools.pairwise(ends):
        x = solve_ivp(written, (begin, end - 1e-12), x, "LSODA", rtol=1e-10, atol=1e-12).y[:, -1]
        n = round(end / 1e-4)
        # both integrators' tolerances over 1e3 steps
        assert float(rows.z[n]) == pytest.approx(x[0], abs=2e-10)
        assert float(rows.i[n]) == pytest.approx((x[2] - x[3]) / 2, abs=2e-7)
        assert float(rows.v[n]) == pytest.approx((x[2] / (p.s_0 - x[0])) ** 2 - (x[3] / (p.s_0 + x[0])) ** 2, abs=1e-2)
        assert float(rows.heat[n]) == pytest.approx(p.R * (x[2] ** 2 + 1.05 * x[3] ** 2), rel=1e-5)


@pytest.mark.slow
def test_a_custom_law_and_plant_are_checked():
    report = check(CASCADE, SCENARIO, CLOCK)
    assert report.holds
    line = next(line for line in report.conditions if line.path == RHO)
    assert (line.requires, line.gain, line.unit) == ("rho > Q_z", 25.0, "m/s^2")
    assert line.against == pytest.approx(0.5 * float(SCENARIO.plant.a))
    # its robust term stands in Eq. (12), and the plant's own force in h: what is left is the integrator's tolerance
    residual = next(line for line in report.proof if line.name == "Eq. (12)")
    assert residual.against < 1e-5 * 0.031
    weak = dataclasses.replace(CASCADE, position=BoundaryLayer(rho=0.01))
    assert next(line for line in check(weak, SCENARIO, CLOCK).conditions if line.path == RHO).holds is False


def test_a_law_without_the_base_class_is_refused():
    wrong: Any = object()
    with pytest.raises(ValueError, match=r"controller\.current = object: .* ambjax\.extend\.CurrentLaw"):
        rollout(dataclasses.replace(CASCADE, current=wrong), SCENARIO, CLOCK)


def test_a_law_that_cannot_be_called_is_refused_in_one_line():
    """tests/test_own_laws.py has other faults of a law."""

    @record
    class Law(BoundaryLayer):
        def __call__(self, model, inputs, state):
            return jnp.ones(2) * inputs[0].z, ()

    said = r"controller\.position = Law: it raised .*Law must return the number v_star .*\(2,\)"
    for run in (rollout, jax.jit(rollout)):
        with pytest.raises(ValueError, match=said) as refused:
            run(dataclasses.replace(CASCADE, position=Law()), SCENARIO, CLOCK)
        assert "\n" not in str(refused.value)
