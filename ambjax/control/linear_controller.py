"""A linear controller designed elsewhere, such as by H-infinity synthesis, as a position law."""

import dataclasses
import types
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.force import force_of_current, linear_mechanics, sliding_variable
from ambjax.control.realisation import FREQUENCIES, Matrices, Realisation, realisation
from ambjax.control.search import Interval, SearchContext
from ambjax.control.stages import PositionInputs, PositionLaw
from ambjax.numerics import records
from ambjax.numerics.records import Scalar, is_traced, record, static
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# Allowed values of `output`; largest relative difference between the sample periods of controller and processor.
OUTPUTS, SAME_PERIOD = ("current", "voltage"), 1e-6
# Default controller: 135 + 0.219 s/(1 + s/10600) A/m, the gains of `StateFeedback` without integral for the plant of
# Table 1.
LEAD = realisation(-10600.0, 1.0, -0.219 * 10600.0**2, 135 + 0.219 * 10600.0)


def state_space_of(system: Any) -> Matrices:
    """Return a system as a state space with the matrices A, B, C, D; its period `dt` (s) is absent if continuous.

    `system`: such an object, or a transfer function of python-control or SciPy with one input and one output. Raises
    ValueError for anything else.
    """
    if all(hasattr(system, name) for name in "ABCD"):
        return system
    try:
        num, den = (
            np.trim_zeros(np.atleast_1d(np.squeeze(np.asarray(x, float))), "f") for x in (system.num, system.den)
        )
        n = len(den) - 1
        num = np.pad(num, ((n + 1 - len(num), 0),)) / den[0]  # the width is negative for an improper one
        A, B, C = np.eye(n, k=-1), np.eye(n, 1), (num[1:] - num[0] * den[1:] / den[0])[None]
        A[:1] = -den[1:] / den[0]
    except (AttributeError, TypeError, ValueError, IndexError):
        raise ValueError(
            f"system = {type(system).__name__}: it must be a state space with the matrices A, B, C, D, such as "
            "control.ss(A, B, C, D, dt), or a proper transfer function with one input and one output."
        ) from None
    matrices = types.SimpleNamespace(A=A, B=B, C=C, D=num[:1, None], dt=getattr(system, "dt", None))
    return cast(Matrices, matrices)


@record
class LinearController(PositionLaw[tuple[Array, ...]]):
    """v_star = dv/dz z + dv/di i_star, i_star = g/b + gain K(s) (r - z): a linear controller in state space.

    K has one input, r - z (m), or two inputs, r and z (m). Its output is a current (A) or a voltage u (V); for a
    voltage, i_star = g/b + gain u/R. g/b is the current that carries the weight, b = a dv/di at z = 0, i = 0. With
    inversion.Linearised, i_ref is i_star. With a voltage, current.OpenLoop then applies R i_ref = gain u + R g/b.

    A continuous K is discretised by the bilinear (Tustin) transform at the period of a processor. A discrete K requires
    a processor with its own period. There is no anti-windup: the states of K do not depend on the supply's limit. The
    reported sigma is the rate of the error, m/s. `of` constructs the law from a system of python-control or SciPy.

    Use it for a controller designed elsewhere:
    `position.LinearController.of(control.ss(A, B, C, D), output="current")`.
    """

    analytic = True
    gain: Scalar = records.gain(1.0, "1", "factor of the controller's output")
    output: str = static(
        default=OUTPUTS[0], choices=OUTPUTS, doc="quantity that the controller returns: a current (A) or a voltage (V)"
    )
    realisation: Realisation = static(default=LEAD, doc="matrices of the controller")
    own_steps = ("implicit", "explicit")

    @classmethod
    def of(cls, system: Any, output: str = OUTPUTS[0], gain: Scalar = 1.0) -> "LinearController":
        """Return the law of a state space or a transfer function of python-control or SciPy, with the period dt (s).

        `output`: "current" or "voltage". `gain`: factor of the output. Raises ValueError if `output` is not allowed, or
        as `state_space_of` and `realisation` do.
        """
        system = state_space_of(system)
        if output not in OUTPUTS:
            raise ValueError(f"output = {output!r}: it must be one of {', '.join(map(repr, OUTPUTS))}.")
        dt = getattr(system, "dt", None)
        return cls(gain, output, realisation(system.A, system.B, system.C, system.D, dt))

    @property
    def demand(self) -> str:
        """ "voltage" if the output is a voltage, otherwise "force"."""
        return "voltage" if self.output == OUTPUTS[1] else "force"

    @property
    def memory(self) -> tuple[tuple[str, str, str], ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return tuple((f"x_{k + 1}", "m", "state of the controller") for k in range(len(self.realisation.A)))

    def check_use(self, model: Plant, period: float | None) -> None:
        """Raise ValueError if the law cannot run with this nominal model, or at this sample period."""
        dt = self.realisation.dt
        if dt and period is None:
            raise ValueError(
                f"the controller is discrete, dt = {dt:g} s, and this case runs in continuous time. Add [processor], "
                f"with clock.sample_period = {dt:g}, or give a continuous controller."
            )
        if dt and period is not None and not abs(period / dt - 1) < SAME_PERIOD:
            raise ValueError(
                f"the controller is discrete, dt = {dt:g} s, and the sample period is {period:g} s. Set "
                f"clock.sample_period = {dt:g}, or resample the controller."
            )
        if self.demand == "voltage" and not is_traced(model.R) and not np.all(np.asarray(model.R) > 0):
            raise ValueError('output = "voltage" needs a coil resistance above 0. Give plant.R, or controller.model.R.')

    def in_continuous_time(self) -> "LinearController":
        """Return the continuous controller that the bilinear transform turns into this one."""
        return dataclasses.replace(self, realisation=dataclasses.replace(self.realisation, dt=0.0))

    def init(self, model: Plant) -> tuple[Array, ...]:
        return (jnp.zeros(()),) * len(self.realisation.A)

    def begin(self, model: Plant, inputs: PositionInputs) -> tuple[Array, ...]:
        """Return the state of `Realisation.steady`, in continuous time and for the bilinear transform."""
        return self.realisation.steady(self._inputs(inputs))

    def scale(self, model: Plant) -> tuple[Scalar, ...]:
        return (model.sizes().z,) * len(self.realisation.A)

    def slope(self, model: Plant) -> Scalar:
        """Return the larger of the fastest pole of the controller and the crossover frequency of the loop, 1/s.

        The crossover is the largest frequency w at which the loop gain is 1 or more.
        """
        size = self.gain * linear_mechanics(model).b * np.abs(self.realisation.response(FREQUENCIES)[:, -1])
        loop = size / FREQUENCIES**2 if self.demand == "force" else size / (model.L * FREQUENCIES**3)
        crossover = jnp.max(jnp.where(loop >= 1, FREQUENCIES, FREQUENCIES[0]))
        return jnp.maximum(self.realisation.fastest, crossover)

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        """Return the rate of the error: a linear controller has no manifold."""
        return sliding_variable(0.0, motion, reference)

    def _inputs(self, inputs: PositionInputs) -> list[Array]:
        (motion, reference), count = inputs, len(self.realisation.D)
        r, z = jnp.asarray(reference.r), jnp.asarray(motion.z)
        return [r - z] if count == 1 else [r, z]

    def _force(self, model: Plant, z: Array, y: Array) -> Array:
        """Return v_star (A^2/m^2) for an output y (A or V) of the controller."""
        i = self.gain * y if self.demand == "force" else self.gain * y / model.R
        return force_of_current(model, z, model.g / linear_mechanics(model).b + i)

    def __call__(
        self, model: Plant, inputs: PositionInputs, state: tuple[Array, ...]
    ) -> tuple[Array, tuple[Array, ...]]:
        w = self._inputs(inputs)
        y = self.realisation.output(state, w)
        return self._force(model, inputs[0].z, y), self.realisation.rates(state, w)

    def step(
        self, model: Plant, inputs: PositionInputs, state: tuple[Array, ...], period: Scalar
    ) -> tuple[Array, tuple[Array, ...]]:
        y, after = self.realisation.step(state, self._inputs(inputs), period)
        return self._force(model, inputs[0].z, y), after

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {"gain": Interval(0.3, 3.0, "a third to three times the controller")}
