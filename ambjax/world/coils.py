"""The two-coil plant: each coil has its own gap, flux and voltage."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, record
from ambjax.numerics.smooth import reciprocal
from ambjax.world.bearing import Bearing, Signals
from ambjax.world.coil_limits import CoilVoltages
from ambjax.world.iron import Iron
from ambjax.world.sensor import Measurement


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

    def rest(self, state: Currents, z: Array) -> Currents:
        return state._replace(z=z, z_dot=jnp.zeros_like(z))

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
