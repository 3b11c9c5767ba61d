"""A linear state space with the inputs and outputs of the closed loop, its frequency response and its poles."""

import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.host.extensions import extra
from ambjax.numerics.records import Scalar
from ambjax.numerics.small_matrices import array_module, held, solve

# Places at which the loop can be broken: the reading of the position sensor, and the command of the laws.
Place = Literal["reading", "command"]
PLACES: tuple[Place, ...] = ("reading", "command")

# Inputs: test signals added to the readings of z (m) and z_dot (m/s), and a disturbance q_z (m/s^2).
INPUTS = ("e_z", "e_z_dot", "q_z")
# Outputs: the readings of z (m) and z_dot (m/s), test signals included, the voltage u (V), the true position z (m), and
# the command of the laws (V, or A for a commanded current), and the reading of i (A).
OUTPUTS = ("z_read", "z_dot_read", "u", "z", "command", "i_read")


class CommandPath(NamedTuple):
    """Path from the command u (V or A) to the plant, x' = A x + b u, where x [n] are the first n states of the loop.

    - `A` [n, n], `b` [n], or [n, c] for c commands: the linearised plant with the lags of sensor and amplifier.
    - `delay`: samples after which the command of a sample begins to act; 0 in continuous time.
    """

    A: Array
    b: Array
    delay: Array

    def held(self, fraction: Any, period: Any) -> tuple[Any, Any]:
        """Return the effects [..., n(, c)] on x at the next sample of a command that is held for a part of this sample.

        `fraction` [...]: part of the sample after which a new command acts. The first result is the effect of the new
        command, per unit; the second is that of the command before it.
        """
        np_ = array_module(self.A)
        A, b = self.A * period, self.b.reshape(len(self.b), -1) * period
        fraction = np_.asarray(fraction)[..., None, None]
        (passed, new), (_, early) = held(A, b, 1 - fraction), held(A, b, fraction)
        old = passed @ early
        return (new, old) if self.b.ndim > 1 else (new[..., 0], old[..., 0])

    def effects(self, period: Scalar, kept: int) -> list[Array]:
        """Return the effects [n(, c)] on x at the next sample of the commands u_n, u_{n-1}, ..., u_{n-kept}."""
        whole = jnp.floor(self.delay)
        new, old = self.held(self.delay - whole, period)
        at = lambda lag, number: jnp.where(jnp.abs(lag - number) < 0.5, 1.0, 0.0)  # noqa: E731
        return [at(whole + 1, lag) * old + at(whole, lag) * new for lag in range(kept + 1)]


# A mode whose growth rate is below this share of the fastest rate is at rest: the difference is a rounding error.
NEUTRAL = 1e-12


class StateSpace(NamedTuple):
    """The linear system x' = A x + B w, y = C x + D w, or x_{n+1} = A x_n + B w_n on a processor.

    - `A` [N, N], `B` [N, 3], `C` [6, N], `D` [6, 3]: matrices in SI units, with the inputs INPUTS and the outputs
      OUTPUTS. On a processor the disturbance q_z is held over a sample.
    - `sizes` [N]: characteristic sizes of the states, with which `scaled` improves the conditioning.
    - `period`: sample period, s; None in continuous time.
    - `path`: path from the command to the plant, at which the loop can be broken; None: not known.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    sizes: Array
    period: Array | None = None
    path: CommandPath | None = None

    def scaled(self) -> "StateSpace":
        """Return the same system with each state divided by its size."""
        s, path = self.sizes, self.path
        if path is not None:
            own = s[: len(path.b)]
            path = path._replace(A=path.A * own / own[:, None], b=path.b / own)
        return self._replace(A=self.A * s / s[:, None], B=self.B / s[:, None], C=self.C * s, sizes=s / s, path=path)

    @property
    def known_path(self) -> CommandPath:
        """The path from the command to the plant. Raises ValueError without one."""
        if self.path is None:
            raise ValueError("path: the path from the command to the plant is not known.")
        return self.path

    def idle(self) -> Array | np.ndarray:
        """Return which states [N] no input reaches, such as an integral whose gain is 0: their deviations stay 0."""
        linked, reached = self.A != 0, (self.B != 0).any(1)
        for _ in range(len(self.A)):
            reached = reached | (linked & reached).any(1)
        return ~reached

    def without_idle(self) -> "StateSpace":
        """Return the system with NumPy arrays, without the states of the laws that no input reaches."""
        one = jax.tree.map(np.asarray, self)
        kept = ~np.asarray(one.idle())
        if one.path is not None:
            kept[: len(one.path.b)] = True  # the states of the plant
        A, B, C, sizes = one.A[kept][:, kept], one.B[kept], one.C[:, kept], one.sizes[kept]
        return one._replace(A=A, B=B, C=C, sizes=sizes)

    def response(self, frequency: Array | np.ndarray) -> Array:
        """Return the complex frequency response at frequencies [F] in Hz, as an array [F, 6 outputs, 3 inputs].

        If the matrices are NumPy arrays, NumPy computes the response, without compilation. If they are JAX arrays, it
        is differentiable.
        """
        A, B, C, D, *_ = self.scaled()
        return C @ _solved(A, self.point(frequency), B) + D

    def point(self, frequency: Array | np.ndarray) -> Any:
        """Return s = 2 pi j f, or z = exp(s T) on a processor, at frequencies [F] in Hz."""
        np_ = array_module(self.A)
        s = 2j * np.pi * np_.asarray(frequency)
        return s if self.period is None else np_.exp(s * self.period)

    def sensitivity(self, frequency: Array | np.ndarray) -> Array:
        """Return S [F] at frequencies [F] in Hz: the complex response of the reading of z to a test signal on it."""
        return self.response(frequency)[:, 0, 0]

    def command_row(self, frequency: Array | np.ndarray) -> Any:
        """Return h [F, n]: response of the command to an input of each state of the plant, in the units of `scaled`."""
        A, _, C, *_ = self.scaled()
        return _solved(A.T, self.point(frequency), C[4][:, None])[:, : len(self.known_path.b), 0]

    def command_effect(self, frequency: Array | np.ndarray, late: Any = 0.0) -> Any:
        """Return the effect [..., F, n] of a unit command on the states of the plant, in the units of `scaled`.

        `late`: additional delay of the command, s, [F] or [..., 1]. On a processor, the effect is that of the hold,
        which begins after the delay and ends one sample later.
        """
        path = self.scaled().known_path
        np_ = array_module(self.A)
        s = 2j * np.pi * np_.asarray(frequency)
        if self.period is None:
            return path.b * np_.exp(-s * late)[..., None]
        delay = path.delay + late / self.period
        whole, back = np_.floor(delay), np_.exp(-s * self.period)[..., None]
        new, before = path.held(delay - whole, self.period)
        return np_.exp(-s * self.period * whole)[..., None] * (new + before * back)

    def loop_transfer(self, frequency: Array | np.ndarray, place: Place, late: Any = 0.0) -> Any:
        """Return the loop transfer L [F], broken at the position reading or at the command, at frequencies [F] in Hz.

        `late`: additional delay (s) at this place, or delays [F] or [..., 1]. At the command, the loop is broken
        between the laws and the plant: the laws remember their own commands. S = 1/(1 + L) is the response of the
        signal at this place to a signal that is added to it.
        """
        np_ = array_module(self.A)
        if place == "reading":
            return (1 / self.sensitivity(frequency) - 1) * np_.exp(-2j * np.pi * np_.asarray(frequency) * late)
        row, own = self.command_row(frequency), self.command_effect(frequency)
        effect = own if isinstance(late, float) and late == 0 else self.command_effect(frequency, late)
        return -np_.sum(row * effect, -1) / (1 + np_.sum(row * own, -1))

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
        control = extra("control", "control")
        matrices = [np.asarray(x) for x in (self.A, self.B, self.C, self.D)]
        step = 0 if self.period is None else float(self.period)
        return control.StateSpace(*matrices, step, inputs=list(INPUTS), outputs=list(OUTPUTS))


def _solved(A: Any, z: Any, B: Any) -> Any:
    """Return (z I - A)^-1 B as `resolvent` does, by NumPy or JAX."""
    if isinstance(A, np.ndarray):
        return resolvent(A, z, B)
    return solve(z[:, None, None] * np.eye(len(A)) - A, jnp.broadcast_to(B + 0j, (*z.shape, *B.shape)))


# From this number of states times points on, a factorisation of A for all points takes less time than one for each.
MANY = 500


def resolvent(A: np.ndarray, z: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return (z I - A)^-1 B, complex, [F, n, m], for a matrix A [n, n], points z [F] and B [n, m].

    A = Q T Q^H with a triangular T (Schur) after balancing, so that the rows of (z I - T) y = Q^H B are solved upwards,
    at all points at once. Both ways are backward stable; they differ by 1e-10 and less for a machine of 140 states.
    """
    n, many = len(A), len(z)
    if n * many < MANY:
        return np.linalg.solve(z[:, None, None] * np.eye(n) - A, np.broadcast_to(B + 0j, (many, *B.shape)))
    T, Q, scale = _schur(np.ascontiguousarray(A, float).tobytes(), n)
    right, y = Q.conj().T @ (B / scale), np.empty((n, many, B.shape[1]), complex)
    flat = y.reshape(n, -1)
    for k in reversed(range(n)):
        y[k] = (right[k] + (T[k, k + 1 :] @ flat[k + 1 :]).reshape(y[k].shape)) / (z - T[k, k])[:, None]
    return np.moveaxis((scale * (Q @ flat)).reshape(y.shape), 1, 0)


@functools.lru_cache(maxsize=8)
def _schur(matrix: bytes, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return T, Q and the scale [n, 1] of the states of a balanced matrix."""
    import scipy.linalg

    balanced, (scale, _) = scipy.linalg.matrix_balance(
        np.frombuffer(matrix).reshape(n, n), permute=False, separate=True
    )
    found: Any = scipy.linalg.schur(balanced, output="complex")
    return found[0], found[1], scale[:, None]
