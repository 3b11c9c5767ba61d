"""Systems that jump at the start of each sample and within it, against exact matrices.

An example of such a system is a controller on a processor.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from ambjax import RK4, AdaptiveRodas3, Clock
from ambjax.extend import canonical, leaf, record
from ambjax.simulation.folds import Driven
from ambjax.simulation.integrate import InitialValueProblem, in_turn
from ambjax.simulation.rollout import roll
from ambjax.simulation.span import Instant
from ambjax.simulation.trajectory import ALIVE, TOUCHED

# x'' = w^2 x + u, which two gains on the sampled state hold
W, GAINS, T, SAMPLES = 40.0, (4500.0, 90.0), 2e-3, 60


class Motion(NamedTuple):
    x: Any
    x_dot: Any


class Held(NamedTuple):
    """The plant, the state of the controller, and the voltages of this sample and of the two previous ones."""

    plant: Motion
    steps: Any
    u: Any
    queue: tuple[Any, Any]


class Line(NamedTuple):
    t: Any
    x: Any
    u: Any
    steps: Any
    u_mean: Any
    alive: Any


class Effort(NamedTuple):
    u: Any


@record
class Sampled:
    """The plant under u_n = -gains (x, x_dot) + noise, which acts from t_n + delay T to t_{n+1} + delay T."""

    gains: tuple[float, float] = GAINS
    delay: Any = leaf(default=0.3)
    start_x: Any = leaf(default=1e-3)
    stop: Any = leaf(default=1.0)

    def realised(self):
        return self

    def sensor_errors(self, sample):
        return 1e-2 * jnp.sin(1.0 * sample)

    def start(self):
        zero = jnp.zeros(())
        return Held(Motion(jnp.asarray(self.start_x), zero), zero, zero, (zero, zero))

    def jump(self, t, state, errors):
        u = -(self.gains[0] * state.plant.x + self.gains[1] * state.plant.x_dot) + errors
        return Held(state.plant, state.steps + 1, u, (state.u, state.queue[0]))

    def driven(self, u):
        """The plant alone under a constant voltage."""
        rates = lambda _, m: Motion(m.x_dot, W**2 * m.x + u)  # noqa: E731
        observed = lambda inputs, m: (rates(inputs, m), Instant((), Effort(u)))  # noqa: E731
        inputs = lambda t: t  # noqa: E731
        return InitialValueProblem(
            inputs,
            rates,
            Motion(1e-3, 0.1),
            self._status,
            observed=observed,
            instant_structure=Instant((), Effort(0.0)),
            jumps=True,
        )

    def advance(self, method, errors, t, period, state, memory, code):
        whole, share = jnp.floor(self.delay), self.delay - jnp.floor(self.delay)
        voltages = jnp.stack([state.u, *state.queue])
        late, early = (jnp.interp(whole + k, jnp.arange(3), voltages) for k in (1, 0))
        stretches = [(self.driven(late), share * period), (self.driven(early), (1 - share) * period)]
        after = in_turn(method, stretches, t, state.plant, memory, code)[-1]
        return after._replace(state=state._replace(plant=after.state))

    def _status(self, plant):
        return jnp.where(jnp.abs(plant.x) < self.stop, ALIVE, TOUCHED).astype(jnp.int32)

    def status(self, state):
        return self._status(state.plant)

    def rest(self, state, code):
        return state._replace(plant=Motion(state.plant.x, jnp.zeros(())))

    def row(self, t, state, errors, alive):
        return Line(t, state.plant.x, state.u, state.steps, 0.0 * t, alive)

    def completed(self, row, span):
        return row._replace(u_mean=span.densities.u / jnp.where(span.time > 0, span.time, 1.0))

    def singularity(self, row):
        return jnp.ones(())


def exact(delay):
    """Return x and u at each sample, and the mean of the acting voltage over it, from the matrix exponential."""
    A = np.array([[0.0, 1.0, 0.0], [W**2, 0.0, 1.0], [0.0, 0.0, 0.0]])
    x, past, found = np.array([1e-3, 0.0]), [0.0, 0.0, 0.0], []
    for n in range(SAMPLES):
        past = [-np.dot(GAINS, x) + 1e-2 * np.sin(n), *past[:-1]]
        share, whole = delay % 1, int(delay)
        parts = [(share, past[min(whole + 1, 2)]), (1 - share, past[whole])]
        found.append((x[0], past[0], sum(s * u for s, u in parts)))
        for s, u in parts:
            x = (expm(A * s * T) @ [*x, u])[:2]
    return np.array(found)


def run(system, method, samples=SAMPLES, fold=None):
    return roll(*canonical((system, Clock(samples, T, method), fold)), every=1)


@pytest.mark.parametrize("method", [RK4(4), AdaptiveRodas3(1e-9)], ids=str)
@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 1.7])
def test_a_sampled_loop_agrees_with_the_matrix_exponential(delay, method):
    found = run(Sampled(delay=delay), method, fold=Driven("u"))
    rows, want = found.trajectory.rows, exact(delay)
    # RK4: (w T/4)^4/120 a step; the adaptive method: its tolerance over some 1e3 steps, and the loop amplifies both
    rtol = 1e-6 if isinstance(method, RK4) else 3e-6
    for got, column in zip((rows.x, rows.u, rows.u_mean), want.T, strict=True):
        np.testing.assert_allclose(got, column, atol=rtol * np.max(np.abs(column)))
    # over all of it: the spans of both parts of a sample are joined
    assert float(found.measured) == pytest.approx(want[:, 2].mean(), abs=1e-6 * np.max(np.abs(want[:, 2])))
    np.testing.assert_array_equal(rows.steps, np.arange(1, SAMPLES + 1))  # the row is that after the jump


def test_a_lost_state_does_not_jump():
    found = run(Sampled(gains=(0.0, 0.0), stop=2e-3), RK4(4)).trajectory
    lost = int(np.argmin(found.rows.alive))
    assert 0 < lost < SAMPLES
    # lost within the sample before: cosh(w t) = 2 up to the noise; found at the end of a substep
    assert float(found.lost_at) == pytest.approx(np.arccosh(2.0) / W, abs=2e-3)
    assert (lost - 1) * T < float(found.lost_at) <= lost * T * (1 + 1e-12)
    for name in ("x", "u", "steps"):
        assert len(set(np.asarray(getattr(found.rows, name))[lost:])) == 1


def test_the_time_of_a_loss_lies_in_its_own_part_of_the_sample():
    for share in (0.1, 0.9):  # lost at 0.46 of a sample: in its second stretch, then in its first
        found = run(Sampled(gains=(0.0, 0.0), stop=2e-3, delay=share), RK4(4)).trajectory
        # found at the end of a substep, 0.225 T later at most; the noise shifts it by 0.05 T
        assert float(found.lost_at) == pytest.approx(np.arccosh(2.0) / W, abs=0.3 * T)


def test_derivatives_include_jumps_and_parts_of_samples():
    def end(delay):
        return run(Sampled(delay=delay), RK4(4)).trajectory.rows.x[-1]

    forward, reverse = jax.jit(jax.jacfwd(end))(0.3), jax.jit(jax.grad(end))(0.3)
    assert float(forward) == pytest.approx(float(reverse), rel=1e-9)
    h = 1e-5
    difference = (float(end(0.3 + h)) - float(end(0.3 - h))) / (2 * h)
    assert float(forward) == pytest.approx(difference, rel=1e-5)
