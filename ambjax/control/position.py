"""Position laws: the scaled force that moves the rotor onto the reference."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.control.base import Requirement
from ambjax.control.laws import PositionLaw
from ambjax.control.sampling import Relay
from ambjax.control.search import Interval, SearchContext, authority, manifold, rate, steepness, switch
from ambjax.numerics.records import Scalar, gain, record
from ambjax.numerics.relax import share, twist
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_root, smooth_sign
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference


def sliding_variable(c: Scalar, motion: Measurement, reference: Reference) -> Array:
    """Return the sliding variable sigma = e_z_dot + c e_z (m/s), with e_z = z - r (Section 3.2)."""
    return motion.z_dot - reference.r_dot + c * (motion.z - reference.r)


def force_for(c: Scalar, model: Plant, motion: Measurement, reference: Reference, robust: Scalar) -> Array:
    """Return the scaled force (A^2/m^2) that gives sigma_dot = `robust` (m/s^2) on the nominal plant. Eqs. (4), (5)."""
    wanted = -2 * model.k_z / model.m * motion.z - c * (motion.z_dot - reference.r_dot)
    return (wanted + reference.r_ddot + model.g + robust) * (1 / model.a)


@record
class SlidingMode(PositionLaw[tuple[()]]):
    """v_star = (-2 k_z z/m - c (z_dot - r_dot) + r_ddot + g - k sgn(sigma)) / a. Eq. (5), sgn smoothed."""

    c: Scalar = gain(default=17.0, unit="1/s", doc="decay rate on the sliding manifold")
    k: Scalar = gain(default=25.0, unit="m/s^2", doc="switching gain; above the disturbance bound Q_z")
    p: Scalar = gain(
        default=25.0,
        unit="s/m",
        doc="steepness of the smoothed sign of sigma; left out: scaled to the plant",
        steepness=True,
    )
    requirement: ClassVar = Requirement("k", "Q_z")

    def init(self, model: Plant) -> tuple[()]:
        return ()

    def scale(self, model: Plant) -> tuple[()]:
        return ()

    def slope(self, model: Plant) -> Scalar:
        return jnp.maximum(TWO_OVER_PI * self.k * self.p, self.c)

    def size(self, model: Plant) -> Scalar:
        return model.sigma_size

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        return sliding_variable(self.c, motion, reference)

    def __call__(
        self, model: Plant, inputs: tuple[Measurement, Reference], state: tuple[()]
    ) -> tuple[Array, tuple[()]]:
        motion, reference = inputs
        robust = self.robust(self.sigma(motion, reference))
        return force_for(self.c, model, motion, reference, robust), ()

    def robust(self, sigma: Array) -> Array:
        return -self.k * smooth_sign(sigma, self.p)

    def relay(self) -> Relay:
        return Relay(self.k, self.p)

    def explicit_rate(self, model: Plant) -> Scalar:
        """Return c: on the manifold the demanded force is that at the start of the sample."""
        return self.c

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        if context.stepped:
            most = context.w**2 * float(context.model.s_0)
            k = authority(context, most, (1e-3, 0.3), "w^2 s_0: what the magnets accelerate the rotor by", "Q_z")
        else:
            k = switch(context, "k", self.p, 100, "Q_z")
        return {"c": manifold(context), "k": k, **steepness(context, "k")}

    def step(
        self, model: Plant, inputs: tuple[Measurement, Reference], state: tuple[()], period: Scalar
    ) -> tuple[Array, tuple[()]]:
        """Step with the sign of sigma at the end of the step: without disturbance sigma reaches 0 and stays there."""
        motion, reference = inputs
        robust = -self.k * share(self.sigma(motion, reference), period * self.k, self.p)
        return force_for(self.c, model, motion, reference, robust), ()


@record
class SuperTwisting(PositionLaw[Array]):
    """sigma_dot = -k_1 sqrt|sigma| sgn(sigma) + w, w' = -k_2 sgn(sigma): the paper's future work.

    Levant, Int. J. Control 58 (1993) 1247-1263. Both terms are smoothed with p: the root as
    sigma / (sigma^2 + 1/p^2)^(1/4), whose slope at zero is sqrt(p). The state w (m/s^2) integrates, so
    a constant disturbance leaves no offset. Default slope at zero: k_1 sqrt(p) = 400 1/s, as SlidingMode has.
    """

    c: Scalar = gain(default=17.0, unit="1/s", doc="decay rate on the sliding manifold")
    k_1: Scalar = gain(default=40.0, unit="m^0.5/s^1.5", doc="gain of the root term")
    k_2: Scalar = gain(default=50.0, unit="m/s^3", doc="gain of the integral; above the bound on dq_z/dt")
    p: Scalar = gain(
        default=100.0,
        unit="s/m",
        doc="steepness of the smoothed root and sign of sigma; left out: scaled to the plant",
        steepness=True,
    )
    memory = (("w", "m/s^2", "integral of the sign of sigma"),)

    def init(self, model: Plant) -> Array:
        return jnp.zeros(())

    def scale(self, model: Plant) -> Scalar:
        return jnp.abs(model.g) / 50 + 1e-3

    def slope(self, model: Plant) -> Scalar:
        root, integral = self.k_1 * jnp.sqrt(self.p), TWO_OVER_PI * self.k_2 * self.p
        # sigma'' + root sigma' + integral sigma = 0 at the origin: the faster of the two modes.
        pole = (root + jnp.sqrt(jnp.maximum(root**2 - 4 * integral, 0.0))) / 2
        return jnp.maximum(jnp.maximum(pole, jnp.sqrt(integral)), self.c)

    def size(self, model: Plant) -> Scalar:
        return model.sigma_size

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        return sliding_variable(self.c, motion, reference)

    def __call__(self, model: Plant, inputs: tuple[Measurement, Reference], state: Array) -> tuple[Array, Array]:
        motion, reference = inputs
        sigma = self.sigma(motion, reference)
        robust = state - self.k_1 * smooth_root(sigma, self.p)
        return force_for(self.c, model, motion, reference, robust), -self.k_2 * smooth_sign(sigma, self.p)

    def explicit_rate(self, model: Plant) -> Scalar:
        """Return c: on the manifold the demanded force is that at the start of the sample."""
        return self.c

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        if context.stepped:
            return {"c": manifold(context), **self._authorities(context)}
        root, integral = float(self.p) ** 0.5, TWO_OVER_PI * float(self.p)
        return {
            "c": manifold(context),
            "k_1": rate(context, 1 / 3, 100, "slope k_1 sqrt(p) from w/3 to 100 w", root),
            "k_2": rate(context, 1e-2, 10, "corner sqrt(2/pi k_2 p) from w/100 to 10 w", integral, 2),
        }

    def _authorities(self, context: SearchContext) -> dict[str, Interval]:
        size = float(context.model.s_0)
        root = authority(context, (context.w**3 * size) ** 0.5, (1e-3, 0.3), "sqrt(w^3 s_0)")
        return {"k_1": root, "k_2": authority(context, context.w**3 * size, (1e-5, 0.1), "w^3 s_0")}

    def step(
        self, model: Plant, inputs: tuple[Measurement, Reference], state: Array, period: Scalar
    ) -> tuple[Array, Array]:
        """Step with both terms at the end of the step (R. Seeber and B. Andritsch, Automatica 173 (2025) 112027).

        The robust term is -k_1 root(y) + 2 w+ - w, y + T k_1 root(y) + T^2 k_2 sgn(y) = sigma.
        """
        motion, reference = inputs
        sigma = self.sigma(motion, reference)
        reach = period * period * self.k_2
        root, sign = twist(sigma, period * self.k_1, reach, self.p)
        after = state - period * self.k_2 * sign
        robust = 2 * after - state - self.k_1 * root
        return force_for(self.c, model, motion, reference, robust), after


class PIDState(NamedTuple):
    """State of `PID`: filtered rate of the error (m/s), and its integral term (m/s^2)."""

    rate: Array
    integral: Array


@record
class PID(PositionLaw[PIDState]):
    """v_star = (-2 k_z z/m + r_ddot + g - k_p e - k_d d - x)/a, e = z - r, d' = w_f (e_dot - d), x' = k_int e + ...

    A PID controller with a filtered derivative and with the nominal plant's stiffness and weight fed forward, so that
    e_ddot = -k_p e - k_d d - x where v = v_star: the gains do not depend on the plant. Astrom and Murray, Feedback
    Systems (2008), 10.1 and 10.4; the feed-forward is that of Eq. (5). e_dot is that of the observer: with "difference"
    d is the textbook's filtered derivative of the position.

    The whole integral is x' = k_int e + k_aw (a v_star - a v(z, i)), back-calculation: while the supply limits u, the
    force v(z, i) of the measured current is not the demanded one, and x follows it at the rate k_aw.

    k_d = 2 w, k_p = 2 w^2, k_int = w^3 are the optimal gains (LQR) for the cost w^6 (int e)^2 + e_ddot^2: its poles are
    those of a Butterworth filter of bandwidth w.
    """

    k_p: Scalar = gain(default=1e4, unit="1/s^2", doc="proportional gain")
    k_int: Scalar = gain(default=1e5, unit="1/s^3", doc="integral gain")
    k_d: Scalar = gain(default=400.0, unit="1/s", doc="derivative gain")
    w_f: Scalar = gain(default=1e4, unit="1/s", doc="bandwidth of the filter of the derivative")
    k_aw: Scalar = gain(default=10.0, unit="1/s", doc="anti-windup rate")
    memory = (("rate", "m/s", "filtered rate of the error"), ("integral", "m/s^2", "integral term"))

    def init(self, model: Plant) -> PIDState:
        return PIDState(jnp.zeros(()), jnp.zeros(()))

    def scale(self, model: Plant) -> PIDState:
        return PIDState(jnp.asarray(model.sigma_size), jnp.abs(model.g) / 50 + 1e-3)

    def slope(self, model: Plant) -> Scalar:
        """Return the largest of the rates w_f, k_d, k_aw, sqrt(k_p) and cbrt(k_int)."""
        rates = jnp.stack([jnp.asarray(x) for x in (self.w_f, self.k_d, self.k_aw)])
        return jnp.maximum(jnp.max(rates), jnp.maximum(jnp.sqrt(self.k_p), jnp.cbrt(self.k_int)))

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        """Return e_dot + (k_p/k_d) e: without filter and integral, e_ddot = -k_d sigma."""
        return sliding_variable(self.k_p / self.k_d, motion, reference)

    def __call__(self, model: Plant, inputs: tuple[Measurement, Reference], state: PIDState) -> tuple[Array, PIDState]:
        motion, reference = inputs
        e, e_dot = motion.z - reference.r, motion.z_dot - reference.r_dot
        v_star = self._force(model, inputs, state.rate, state.integral)
        lacking = model.a * (v_star - model.v(motion.z, motion.i))
        return v_star, PIDState(self.w_f * (e_dot - state.rate), self.k_int * e + self.k_aw * lacking)

    def _force(self, model: Plant, inputs: tuple[Measurement, Reference], rate: Array, integral: Scalar) -> Array:
        motion, reference = inputs
        wanted = -self.k_p * (motion.z - reference.r) - self.k_d * rate - integral
        return force_for(0.0, model, motion, reference, wanted)

    def explicit_rate(self, model: Plant) -> Scalar:
        """Return the larger of k_d and sqrt(k_p): the demanded force is that at the start of the sample."""
        return jnp.maximum(self.k_d, jnp.sqrt(self.k_p))

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {
            "k_p": rate(context, 1 / 30, 3, "corner sqrt(k_p) from w/30 to 3 w", power=2),
            "k_int": rate(context, 1 / 100, 1, "corner cbrt(k_int) from w/100 to w", power=3),
            "k_d": rate(context, 1 / 10, 10, "rate k_d from w/10 to 10 w"),
            "w_f": rate(context, 1, 100, "bandwidth from w to 100 w"),
            "k_aw": rate(context, 1e-3, 1, "rate from w/1000 to w"),
        }

    def step(
        self, model: Plant, inputs: tuple[Measurement, Reference], state: PIDState, period: Scalar
    ) -> tuple[Array, PIDState]:
        """Step the filter and the anti-windup by backward Euler: both are stable for any rate.

        d+ = d + T w_f (e_dot - d+); v_star uses d+ and x; x+ = x + T (k_int e + k_aw (a v_star(x+) - a v(z, i))).
        """
        motion, reference = inputs
        e, e_dot = motion.z - reference.r, motion.z_dot - reference.r_dot
        follow, leak = period * self.w_f, period * self.k_aw
        after = (state.rate + follow * e_dot) / (1 + follow)
        lacking = model.a * (self._force(model, inputs, after, 0.0) - model.v(motion.z, motion.i))
        integral = (state.integral + period * self.k_int * e + leak * lacking) / (1 + leak)
        return self._force(model, inputs, after, state.integral), PIDState(after, integral)
