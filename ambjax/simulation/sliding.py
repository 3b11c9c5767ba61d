"""The sliding step: an integration step for a closed loop whose only stiff part is a sliding inversion law.

The adaptive inversion law is such a law: w' = d - gamma sgn(w) for w = v_star - v(z, i_ref), Eq. (14a). Here d is the
rate of w at constant i_ref, and sgn is a smoothed sign of steepness p. When the measurements jump at a sample, i_ref
slides to its new value within microseconds, and then follows that value. General methods are not suitable. A
linearised implicit step has no stiffness in its Jacobian while the sign is saturated, and overshoots by gamma h. An
explicit step must be shorter than 1/(gamma p).

This step is divided at the end of the slide. The second part is solved implicitly with the full arctan, not with its
slope. The supply's limit applies to each part. A fast slide saturates the voltage, so the current receives a
bounded impulse instead of the whole jump.

The states of the observer and of the position law are integrated by Heun's method. The motion of the rotor is
integrated with an acceleration linear in time between those at the start and at the predicted end. In each part, the
current is integrated by an exponential step, and the state of the current law by an explicit Euler step.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import compiled_alone, materialised
from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import Sample
from ambjax.control.schedule import with_gains_at
from ambjax.control.stages import CurrentDemand, CurrentInputs
from ambjax.numerics.linear import axpy
from ambjax.numerics.records import Scalar, record
from ambjax.numerics.smooth import limited
from ambjax.simulation.integrate import FixedSteps, InitialValueProblem, Times
from ambjax.simulation.trajectory import Instant, Span
from ambjax.world.plant import State
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Errors, Measurement

S = TypeVar("S")


def slide(loop: Any, errors: Errors, begin: Any, end: Any, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
    """Advance the state of a ClosedLoop by h (s). `slides` must be true for its cascade and its plant."""
    cascade, scenario = loop.cascade, loop.scenario
    model, (z, z_dot, i, _), control = cascade.model, state.plant, state.control
    i_ref = control.inversion
    per_h = 1 / jnp.where(h > 0, h, 1.0)

    read = loop.received(begin, state.plant, errors)
    force_0, estimate_0, rates_0, _ = cascade.demand(read, control, Sample(begin.reference))
    z_ddot_0 = scenario.plant.z_ddot(z, i, begin.q_z)
    ahead = State(z + h * z_dot + h * h / 2 * z_ddot_0, z_dot + h * z_ddot_0, i)
    control_1 = control._replace(
        observer=axpy(control.observer, (h, rates_0.observer)), position=axpy(control.position, (h, rates_0.position))
    )
    ahead, control_1, force_0 = materialised((ahead, control_1, force_0))
    read = loop.received(end, ahead, errors)
    force_1, estimate_1, rates_1, _ = cascade.demand(read, control_1, Sample(end.reference))

    inversion = with_gains_at(cascade.inversion, estimate_0.z, begin.reference)
    sliding, slaved, tau, (w, w_1, w_2) = inversion.slide(model, force_0, force_1, i_ref, h)
    sliding, slaved, tau, force_1 = materialised((sliding, slaved, tau, force_1))

    def current(
        plant: State, estimate: Measurement, i_ref: Array, rate: Array, inner: S, outside: Any, h: Array
    ) -> tuple[Array, S, _Voltage]:
        """Integrate the current over h (s) at constant i_ref' = rate. Return i - i_ref, the law's state, and u."""
        law = with_gains_at(cascade.current, estimate.z, outside.reference)

        def rate_of(i: Array) -> tuple[Array, tuple[S, Array]]:
            inputs = CurrentInputs(estimate._replace(i=i + errors.i), CurrentDemand(i_ref, rate), scenario.u_max)
            u, inner_rate = law(model, inputs, inner)
            u = limited(u, scenario.u_max)
            return scenario.plant.i_dot(plant.z, plant.z_dot, i, u, outside.q_i), (inner_rate, u)

        i_dot, slope, (inner_rate, u) = jax.jvp(rate_of, (plant.i,), (jnp.ones_like(plant.i),), has_aux=True)
        phi, volts = _phi(h * slope), scenario.plant.u_per_i_dot(plant.z)
        e = plant.i - i_ref + h * phi * (i_dot - rate)
        return e, axpy(inner, (h, inner_rate)), _Voltage(u, (rate - i_dot) * volts, h * slope, phi)

    e, inner, first = current(state.plant, estimate_0, i_ref, sliding, control.current, begin, tau)
    e, inner = materialised((e, inner))
    i_ref_0, i_ref = i_ref, i_ref + tau * sliding
    middle = State((z + ahead.z) / 2, (z_dot + ahead.z_dot) / 2, i_ref + e)
    estimate = jax.tree.map(lambda a, b: (a + b) / 2, estimate_0, estimate_1)
    # The current changes fast during the slide. The accelerations before and after it are weighted by the durations.
    z_ddot_0 += (1 - tau * per_h) * (scenario.plant.z_ddot(z, middle.i, begin.q_z) - z_ddot_0)
    e, inner, second = current(middle, estimate, i_ref, slaved, inner, end, h - tau)
    e, inner = materialised((e, inner))
    i_ref = i_ref + (h - tau) * slaved
    z_ddot_1 = scenario.plant.z_ddot(ahead.z, i_ref + e, end.q_z)
    plant = State(
        z + h * z_dot + h * h / 6 * (2 * z_ddot_0 + z_ddot_1), z_dot + h / 2 * (z_ddot_0 + z_ddot_1), i_ref + e
    )
    # tau = 0: no slide, because w was inside the boundary layer of the sign, or did not move towards this layer.
    instants = (
        loop.instant(begin.reference, state.plant, i_ref_0, w, jnp.where(tau > 0, first.u, second.u)),
        loop.instant(begin.reference, state.plant._replace(i=middle.i), i_ref - (h - tau) * slaved, w_1, second.u),
        loop.instant(end.reference, plant, i_ref, w_2, second.end(scenario.u_max)),
    )
    span = _with_step(span, instants, first.u, second, tau, h - tau)
    control = control._replace(
        observer=axpy(control.observer, (h / 2, rates_0.observer), (h / 2, rates_1.observer)),
        position=axpy(control.position, (h / 2, rates_0.position), (h / 2, rates_1.position)),
        inversion=i_ref,
        current=inner,
    )
    return state._replace(plant=plant, control=control), span


class _Voltage(NamedTuple):
    """Voltage over one part of a step, from the exponential step: u + amplitude (1 - exp(x s)), s from 0 to 1."""

    u: Array
    amplitude: Array
    x: Array
    phi: Array
    """(exp(x) - 1) / x"""

    def end(self, u_max: Scalar) -> Array:
        """Return u at the end, V."""
        return limited(self.u - self.amplitude * self.x * self.phi, u_max)

    def moments(self) -> tuple[Array, Array]:
        """Return the means of u, V, and of u^2, V^2."""
        rest, once, twice = self.u + self.amplitude, self.amplitude * self.phi, self.phi * (1 + self.x * self.phi / 2)
        return rest - once, rest * (rest - 2 * once) + self.amplitude * self.amplitude * twice


def _with_step(span: Span, instants: tuple[Instant, ...], u: Array, rest: _Voltage, tau: Array, left: Array) -> Span:
    """Add a step to the span: voltage `u` for tau, then `rest` for `left`."""
    before = span.densities
    for instant, weight in zip(instants, (tau / 2, (tau + left) / 2, left / 2), strict=True):
        span = span.with_instant(instant, weight)
    mean, square = materialised(rest).moments()
    densities = span.densities._replace(
        u=before.u + tau * u + left * mean, u_squared=before.u_squared + tau * u * u + left * square
    )
    return span._replace(time=span.time + tau + left, densities=densities)


@jax.custom_jvp
@compiled_alone
def _phi(x: Array) -> Array:
    """Return (exp(x) - 1) / x."""
    small = jnp.abs(x) < 1e-3
    return jnp.where(small, 1 + x / 2 + x * x / 6, (jnp.exp(x) - 1) * (1 / jnp.where(small, 1.0, x)))


@_phi.defjvp
def _phi_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    y, small = _phi(x), jnp.abs(x) < 1e-3
    slope = jnp.where(small, 1 / 2 + x / 3 + x * x / 8, (1 + (x - 1) * y) * (1 / jnp.where(small, 1.0, x)))
    return y, slope * dx


def slides(cascade: Cascade, scenario: Scenario) -> bool:
    """Return whether this step applies to the cascade and the scenario."""
    slow = not cascade.observer.stiff  # Heun's method integrates the observer
    paper = scenario.plant.lumped and scenario.drive == "voltage" and scenario.stop is None
    return not cascade.sampled and cascade.inversion.slides and slow and paper


@record
class Slide(FixedSteps):
    """The sliding step (`ambjax.simulation.sliding`) with equal substeps, for stiff gains under held noise.

    The step is of second order in the slow motion of the loop, for any stiffness of the inversion law. It requires
    continuous time, an inversion law with a method `slide`, such as `inversion.Adaptive`, a lumped plant, an observer
    that is not `stiff`, and a scenario with a voltage drive and without an elastic stop; otherwise a simulation raises
    ValueError.

    Use it for long studies with stiff adaptive inversion: `Clock(1000, 1e-4, solvers.Slide(4))`.
    """

    title = "sliding step"

    def _step(self, problem: InitialValueProblem, at: Times, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
        if problem.slide is None:
            raise ValueError(
                "clock.method = Slide(...): it requires continuous time, a lumped plant without iron, the 'adaptive' "
                "inversion law, an observer other than IRED1 and IRED2, a voltage drive, and no elastic stop. Use "
                "Rodas3."
            )
        return problem.slide(problem.inputs(at(0.0)), problem.inputs(at(1.0)), h, state, span)
