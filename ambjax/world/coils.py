"""The two-coil plant: each coil has its own gap, flux and voltage."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, record
from ambjax.world.bearing import Bearing, Signals
from ambjax.world.sensor import Measurement


class Currents(NamedTuple):
    """State of `TwoCoil`: displacement (m), velocity (m/s), currents of the upper and lower coil (A); or the rates."""

    z: Array
    z_dot: Array
    i_1: Array
    i_2: Array


@record
class TwoCoil(Bearing[Currents]):
    """Rotor and magnets with the parameters of Table 1, in the state (z, z_dot, i_1, i_2).

    The upper coil (gap s_0 - z) has the voltage R i_0 + u, the lower one (gap s_0 + z) R i_0 - u. The measured i is
    half the difference of the currents. The flux linkage kappa i_1 / (2 (s_0 - z)) of the upper coil has the rate
    u + R (i_0 - i_1); the lower coil likewise. Deviation: Eq. (2) has one current, that of the lower gap.
    """

    def start(self, measurement: Measurement) -> Currents:
        z, z_dot, i = measurement
        return Currents(z, z_dot, self.i_0 + i, self.i_0 - i)

    def rates(self, state: Currents, u: Scalar, q_z: Scalar = 0.0, q_i: Scalar = 0.0) -> Currents:
        """Return the rates as `Plant.rates` does; q_i (A/s) disturbs the measured current."""
        z, z_dot, i_1, i_2 = state
        gaps = self.gaps(z)
        above, below = gaps.inverses
        z_ddot = 2 * self.k_z / self.m * z + self.a * ((i_1 * above) ** 2 - (i_2 * below) ** 2) - self.g + q_z
        up, down = u + self.R * (self.i_0 - i_1), self.R * (self.i_0 - i_2) - u
        i_1_dot = (2 / self.kappa) * gaps.upper * up - i_1 * z_dot * above + q_i
        i_2_dot = (2 / self.kappa) * gaps.lower * down + i_2 * z_dot * below - q_i
        return Currents(z_dot, z_ddot, i_1_dot, i_2_dot)

    def rest(self, state: Currents, z: Array) -> Currents:
        return state._replace(z=z, z_dot=jnp.zeros_like(z))

    def scale(self) -> Currents:
        z, z_dot, i = self.sizes()
        return Currents(z, z_dot, i, i)

    def measurement(self, state: Currents) -> Measurement:
        return Measurement(state.z, state.z_dot, (state.i_1 - state.i_2) / 2)

    def coil_currents(self, state: Currents) -> tuple[Array, Array]:
        return state.i_1, state.i_2

    def signals(self, state: Currents) -> Signals:
        above, below = self.gaps(state.z).inverses
        heat = self.R * (state.i_1**2 + state.i_2**2)
        return Signals((state.i_1 * above) ** 2 - (state.i_2 * below) ** 2, heat)
