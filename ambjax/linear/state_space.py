"""A linear state space with the inputs and outputs of the closed loop, its frequency response and its poles."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

# Inputs: test signals added to the readings of z (m) and z_dot (m/s), and a disturbance q_z (m/s^2).
INPUTS = ("e_z", "e_z_dot", "q_z")
# Outputs: the readings of z (m) and z_dot (m/s), test signals included, the voltage u (V), and the true position z (m).
OUTPUTS = ("z_read", "z_dot_read", "u", "z")

# A mode whose growth rate is below this share of the fastest rate is at rest: the difference is a rounding error.
NEUTRAL = 1e-12


class StateSpace(NamedTuple):
    """The linear system x' = A x + B w, y = C x + D w, or x_{n+1} = A x_n + B w_n on a processor.

    - `A` [N, N], `B` [N, 3], `C` [4, N], `D` [4, 3]: matrices in SI units, with the inputs INPUTS and the outputs
      OUTPUTS. On a processor the disturbance q_z is held over a sample.
    - `sizes` [N]: characteristic sizes of the states, with which `scaled` improves the conditioning.
    - `period`: sample period, s; None in continuous time.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    sizes: Array
    period: Array | None = None

    def scaled(self) -> "StateSpace":
        """Return the same system with each state divided by its size."""
        s = self.sizes
        return self._replace(A=self.A * s / s[:, None], B=self.B / s[:, None], C=self.C * s, sizes=s / s)

    def idle(self) -> Array | np.ndarray:
        """Return which states [N] no input reaches, such as an integral whose gain is 0: their deviations stay 0."""
        linked, reached = self.A != 0, (self.B != 0).any(1)
        for _ in range(len(self.A)):
            reached = reached | (linked & reached).any(1)
        return ~reached

    def without_idle(self) -> "StateSpace":
        """Return the system with NumPy arrays, without the states that no input reaches."""
        one = StateSpace(*(None if x is None else np.asarray(x) for x in self))  # pyright: ignore[reportArgumentType]
        kept = ~np.asarray(one.idle())
        A, B, C, sizes = one.A[kept][:, kept], one.B[kept], one.C[:, kept], one.sizes[kept]
        return one._replace(A=A, B=B, C=C, sizes=sizes)

    def response(self, frequency: Array | np.ndarray) -> Array:
        """Return the complex frequency response at frequencies [F] in Hz, as an array [F, 4 outputs, 3 inputs].

        If the matrices are NumPy arrays, NumPy computes the response, without compilation. If they are JAX arrays, it
        is differentiable.
        """
        np_ = np if isinstance(self.A, np.ndarray) else jnp
        A, B, C, D, *_ = self.scaled()
        s = 2j * np.pi * np_.asarray(frequency)[:, None, None]
        at = s if self.period is None else np_.exp(s * self.period)
        x = np_.linalg.solve(at * np.eye(len(A)) - A, np_.broadcast_to(B + 0j, (at.shape[0], *B.shape)))
        return C @ x + D

    def sensitivity(self, frequency: Array | np.ndarray) -> Array:
        """Return S [F] at frequencies [F] in Hz: the complex response of the reading of z to a test signal on it."""
        return self.response(frequency)[:, 0, 0]

    def poles(self) -> np.ndarray:
        """Return the poles [N], complex: in the z-plane on a processor, else in 1/s."""
        return np.linalg.eigvals(np.asarray(self.scaled().A))

    @property
    def stable(self) -> bool:
        """Whether no mode grows: no pole is outside the unit circle, or right of the imaginary axis in continuous time.

        A pole on this border, up to rounding errors (NEUTRAL), is that of a mode at rest. An integral with a gain of
        1e-20 has such a pole.
        """
        poles = self.poles()
        if self.period is None:
            return bool(np.all(np.real(poles) <= NEUTRAL * np.max(np.abs(poles), initial=0.0)))
        return bool(np.all(np.abs(poles) <= 1 + NEUTRAL))

    def to_control(self) -> Any:
        """Return the system as a `StateSpace` of python-control, with the names INPUTS and OUTPUTS.

        Raises ValueError if python-control is not installed (extra `[control]`).
        """
        try:
            import control
        except ImportError:
            raise ValueError(
                "to_control: python-control is not installed. Install it with: pip install 'ambjax[control]'."
            ) from None
        matrices = [np.asarray(x) for x in (self.A, self.B, self.C, self.D)]
        step = 0 if self.period is None else float(self.period)
        return control.StateSpace(*matrices, step, inputs=list(INPUTS), outputs=list(OUTPUTS))
