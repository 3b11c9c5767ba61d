"""The plants: that of the paper, with one current deviation for both coils (Eqs. (1), (2)), and the two-coil plant."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, record
from ambjax.numerics.smooth import reciprocal
from ambjax.world.amplifier import CoilVoltages
from ambjax.world.bearing import Bearing, Signals
from ambjax.world.magnet import Iron
from ambjax.world.sensor import Measurement


class State(NamedTuple):
    """Displacement (m), velocity (m/s) and current deviation (A); or their rates.

    `delayed`: with eddy currents, the delayed current deviation that determines the flux (A); () without.
    """

    z: Array
    z_dot: Array
    i: Array
    delayed: Array | tuple[()] = ()


@record
class Plant(Bearing[State]):
    """The plant of the paper, with the parameters of Table 1. Its state is (z, z_dot, i). Eqs. (1), (2).

    Use it for comparisons with the paper: `Scenario(plant=plants.Plant(m=1.6))`. A real bearing is a `TwoCoil`.
    """

    one_current = True

    def start(self, measurement: Measurement) -> State:
        return State(*measurement, delayed=measurement.i if self.delays else ())

    def rates(self, state: State, u: Scalar, q_z: Scalar = 0.0, q_i: Scalar = 0.0) -> State:
        """Return z_dot (m/s), `z_ddot` and `i_dot` under u (V), q_z (m/s^2) and q_i (A/s). Eqs. (1), (2)."""
        if self.iron is not None:
            return self._iron_rates(self.iron, state, u, q_z, q_i)
        z, z_dot, i, _ = state
        gaps = self.gaps(z)
        z_ddot = 2 * self.k_z / self.m * z + self.a * self.v_and_dv_di(z, i, gaps)[0] - self.g + q_z
        i_dot = 2 * z_dot * gaps.inverses[1] * i + (2 / self.kappa) * gaps.lower * (u - self.R * i) + q_i
        return State(z_dot, z_ddot, i_dot)

    def _iron_rates(self, iron: Iron, state: State, u: Scalar, q_z: Scalar, q_i: Scalar) -> State:
        """Return the rates with iron: Eq. (2) with an inductance that leakage increases and saturation reduces.

        Both the inductance and the voltage that the motion induces are derivatives of the flux linkage. One current
        describes both coils, so they contain the mean of `Iron.slope` over both cores.
        """
        z, z_dot, i, delayed = state
        gaps = self.gaps(z)
        z_ddot = 2 * self.k_z / self.m * z + self.a * self.pull(self.flux_currents(state), z, gaps) - self.g + q_z
        below = gaps.inverses[1]
        cores = (
            iron.core(self, current, inverse)
            for current, inverse in zip(self.currents(state), gaps.inverses, strict=True)
        )
        slope = sum(iron.slope(b) for b in cores) / 2
        motional = slope * (self.kappa * z_dot * i * below * below)
        per_inductance = (2 / self.kappa) * reciprocal(slope * (below + iron.beside(self)))
        i_dot = per_inductance * (motional + u - self.R * i) + q_i
        return State(z_dot, z_ddot, i_dot, () if isinstance(delayed, tuple) else iron.following(i, delayed))

    def scale(self) -> State:
        return self.start(self.sizes())

    def measurement(self, state: State) -> Measurement:
        return Measurement(*state[:3])

    def flux_currents(self, state: State) -> tuple[Array, Array]:
        i = state.i if isinstance(state.delayed, tuple) else state.delayed
        return self.i_0 + i, self.i_0 - i

    def signals(self, state: State) -> Signals:
        v = self.v(state.z, state.i) if self.iron is None else self.pull(self.flux_currents(state), state.z)
        return Signals(v, self.copper_loss(state.i))

    def z_ddot(self, z: Scalar, i: Scalar, q_z: Scalar = 0.0) -> Array:
        """Acceleration, in m/s^2: 2 k_z z/m + a v(z, i) - g + q_z. Eq. (1)."""
        return self.rates(State(*map(jnp.asarray, (z, 0.0, i))), 0.0, q_z).z_dot

    def i_dot(self, z: Scalar, z_dot: Scalar, i: Scalar, u: Scalar, q_i: Scalar = 0.0) -> Array:
        """Rate of the current deviation, in A/s: 2 z_dot i/(s_0+z) + 2 (s_0+z)(u - R i)/kappa + q_i. Eq. (2)."""
        return self.rates(State(*map(jnp.asarray, (z, z_dot, i))), u, 0.0, q_i).i

    def u_per_i_dot(self, z: Scalar) -> Array:
        """Voltage per rate of the current, in V s/A: kappa / (2 (s_0+z)). Eq. (2)."""
        return (self.kappa / 2) * self.gaps(z).inverses[1]


class Currents(NamedTuple):
    """State of `TwoCoil`: displacement (m), velocity (m/s), currents of the upper and lower coil (A); or the rates.

    `delayed`: with eddy currents, the delayed currents that determine the fluxes (A); () without.
    """

    z: Array
    z_dot: Array
    i_1: Array
    i_2: Array
    delayed: tuple[Array, Array] | tuple[()] = ()


@record
class TwoCoil(Bearing[Currents]):
    """The plant with two circuits, with the parameters of Table 1. Its state is (z, z_dot, i_1, i_2).

    The upper coil (gap s_0 - z) has the voltage R i_0 + u, the lower one (gap s_0 + z) R i_0 - u. The current deviation
    i is half the difference of the currents. With ideal iron, the flux linkage kappa i_1 / (2 (s_0 - z)) of the upper
    coil has the rate u + R (i_0 - i_1); that of the lower coil, kappa i_2 / (2 (s_0 + z)), has the rate
    R (i_0 - i_2) - u. In the paper, Eq. (2) has a single current and contains only the lower gap.

    Use it for a real bearing: `Scenario(plant=plants.TwoCoil(m=1.6))`.
    """

    two_voltages = True

    def start(self, measurement: Measurement) -> Currents:
        z, z_dot, i = measurement
        currents = self.i_0 + i, self.i_0 - i
        return Currents(z, z_dot, *currents, currents if self.delays else ())

    def rates(self, state: Currents, u: Scalar | CoilVoltages, q_z: Scalar = 0.0, q_i: Scalar = 0.0) -> Currents:
        """Return the rates as `Plant.rates` does; q_i (A/s) disturbs the measured current.

        `u`: one number (V) for both coils, or the `CoilVoltages`.
        """
        z, z_dot, i_1, i_2, delayed = state
        gaps = self.gaps(z)
        above, below = gaps.inverses
        v = self.pull(self.flux_currents(state), z, gaps)
        z_ddot = 2 * self.k_z / self.m * z + self.a * v - self.g + q_z
        upper, lower = u if isinstance(u, CoilVoltages) else (u, u)
        up, down = upper + self.R * (self.i_0 - i_1), self.R * (self.i_0 - i_2) - lower
        if self.iron is None:
            i_1_dot = (2 / self.kappa) * gaps.upper * up - i_1 * z_dot * above + q_i
            i_2_dot = (2 / self.kappa) * gaps.lower * down + i_2 * z_dot * below - q_i
            return Currents(z_dot, z_ddot, i_1_dot, i_2_dot)
        i_1_dot = self._current_rate(self.iron, i_1, above, z_dot, up) + q_i
        i_2_dot = self._current_rate(self.iron, i_2, below, -z_dot, down) - q_i
        slow = (self.iron.following(i_1, delayed[0]), self.iron.following(i_2, delayed[1])) if delayed else ()
        return Currents(z_dot, z_ddot, i_1_dot, i_2_dot, slow)

    def _current_rate(self, iron: Iron, i: Array, inverse: Array, closing: Array, voltage: Array) -> Array:
        """Return the rate of a coil's current, A/s. The flux linkage is n A b, with the flux density b of the core.

        `i`: current, A. `inverse`: 1 / gap, 1/m. `closing`: rate at which the gap closes, m/s. `voltage`: rate of the
        flux linkage, V.
        """
        permeance = inverse + iron.beside(self)
        slope = iron.slope(iron.core(self, i, inverse))
        per_inductance = reciprocal(slope * permeance)  # in units of 2 / kappa
        return per_inductance * ((2 / self.kappa) * voltage - slope * (i * closing) * (inverse * inverse))

    def scale(self) -> Currents:
        z, z_dot, i = self.sizes()
        return Currents(z, z_dot, i, i, (i, i) if self.delays else ())

    def measurement(self, state: Currents) -> Measurement:
        return Measurement(state.z, state.z_dot, (state.i_1 - state.i_2) / 2)

    def currents(self, state: Currents) -> tuple[Array, Array]:
        return state.i_1, state.i_2

    def flux_currents(self, state: Currents) -> tuple[Array, Array]:
        return state.delayed or (state.i_1, state.i_2)

    def signals(self, state: Currents) -> Signals:
        heat = self.R * (state.i_1**2 + state.i_2**2)
        return Signals(self.pull(self.flux_currents(state), state.z), heat)
