"""The plant of the paper: one current deviation for both coils, Eqs. (1) and (2)."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, record
from ambjax.numerics.smooth import reciprocal
from ambjax.world.bearing import Bearing, Signals
from ambjax.world.iron import Iron
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

    def rest(self, state: State, z: Array) -> State:
        return state._replace(z=z, z_dot=jnp.zeros_like(z))

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
