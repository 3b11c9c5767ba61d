"""The plant of the paper: both coils under one current deviation, Eqs. (1) and (2)."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, record
from ambjax.world.bearing import Bearing, Signals
from ambjax.world.sensor import Measurement


class State(NamedTuple):
    """Displacement (m), velocity (m/s) and current deviation (A); or their rates."""

    z: Array
    z_dot: Array
    i: Array


@record
class Plant(Bearing[State]):
    """Rotor and magnets with the parameters of Table 1, in the state (z, z_dot, i)."""

    lumped = True

    def start(self, measurement: Measurement) -> State:
        return State(*measurement)

    def rates(self, state: State, u: Scalar, q_z: Scalar = 0.0, q_i: Scalar = 0.0) -> State:
        """z_dot, `z_ddot` and `i_dot`. Eqs. (1), (2)."""
        z, z_dot, i = state
        gaps = self.gaps(z)
        z_ddot = 2 * self.k_z / self.m * z + self.a * self.v_and_dv_di(z, i, gaps)[0] - self.g + q_z
        i_dot = 2 * z_dot * gaps.inverses[1] * i + (2 / self.kappa) * gaps.lower * (u - self.R * i) + q_i
        return State(z_dot, z_ddot, i_dot)

    def rest(self, state: State, z: Array) -> State:
        return State(z, jnp.zeros_like(z), state.i)

    def scale(self) -> State:
        return State(*self.sizes())

    def measurement(self, state: State) -> Measurement:
        return Measurement(*state)

    def signals(self, state: State) -> Signals:
        return Signals(self.v(state.z, state.i), self.copper_loss(state.i))

    def z_ddot(self, z: Scalar, i: Scalar, q_z: Scalar = 0.0) -> Array:
        """Acceleration, in m/s^2: 2 k_z z/m + a v(z, i) - g + q_z. Eq. (1)."""
        return self.rates(State(*map(jnp.asarray, (z, 0.0, i))), 0.0, q_z).z_dot

    def i_dot(self, z: Scalar, z_dot: Scalar, i: Scalar, u: Scalar, q_i: Scalar = 0.0) -> Array:
        """Rate of the current deviation, in A/s: 2 z_dot i/(s_0+z) + 2 (s_0+z)(u - R i)/kappa + q_i. Eq. (2)."""
        return self.rates(State(*map(jnp.asarray, (z, z_dot, i))), u, 0.0, q_i).i

    def u_per_i_dot(self, z: Scalar) -> Array:
        """Voltage per rate of the current, in V s/A: kappa / (2 (s_0+z)). Eq. (2)."""
        return (self.kappa / 2) * self.gaps(z).inverses[1]
