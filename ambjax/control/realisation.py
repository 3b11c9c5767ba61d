"""The matrices of a linear controller in real Schur form, computed from a state space that another tool designed."""

import dataclasses
import functools
import hashlib
from collections.abc import Sequence
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from ambjax.numerics.records import Scalar

# Largest number of states. In continuous time an implicit step solves for all of them with scalar operations.
MOST_STATES = 30
# The same for the controller of a machine, which is computed with arrays.
MOST_OF_MACHINE = 300
# The states are scaled by their largest response to the inputs at these angular frequencies (1/s). The response is
# evaluated at s = w (j + DAMPED), to the right of the imaginary axis, because an undamped pole may lie on it.
FREQUENCIES, DAMPED = np.geomspace(10.0, 1e5, 81), 0.05
# Largest condition number of A + I of a discrete controller. Above it, a pole is too close to z = -1.
MOST_CONDITION = 1e8
# Modes of a controller below this rate (1/s) count as integrals, which start at 0.
SLOWEST = 10.0

Row = tuple[float, ...]


class Matrices(Protocol):
    """A state space of another package, such as python-control or SciPy; its period `dt` (s) is optional."""

    A: npt.ArrayLike
    B: npt.ArrayLike
    C: npt.ArrayLike
    D: npt.ArrayLike


@dataclasses.dataclass(frozen=True, repr=False)
class Realisation:
    """The controller x' = A x + B w, y = C x + D w with n states and m = 1 or 2 inputs w; y is a scalar.

    `A` [n, n]: upper quasi-triangular (real Schur form). `B` [n, m], `C` [n], `D` [m]. The states are scaled, so that
    for inputs w of amplitude 1 their amplitudes are about 1 or less. `dt`: sample period of a discrete controller, s;
    0: continuous. For a discrete controller, the matrices are those of a continuous one, whose bilinear transform
    with period dt is the discrete controller. `realisation` constructs a `Realisation` from arrays.
    """

    A: tuple[Row, ...]
    B: tuple[Row, ...]
    C: Row
    D: Row
    dt: float = 0.0

    def __repr__(self) -> str:
        return f"Realisation({len(self.A)} states, {len(self.D)} inputs, dt = {self.dt:g})"

    @property
    def digest(self) -> str:
        return hashlib.sha256(repr((self.A, self.B, self.C, self.D, self.dt)).encode()).hexdigest()

    @property
    def fastest(self) -> float:
        """Largest magnitude of a pole, 1/s."""
        return float(np.max(np.abs(np.linalg.eigvals(np.array(self.A))), initial=0.0)) if self.A else 0.0

    def response(self, w: npt.ArrayLike) -> np.ndarray:
        """Return the frequency response [F, m], complex, at angular frequencies w [F] in 1/s."""
        n = len(self.A)
        A, B = np.reshape(self.A, (n, n)), np.reshape(self.B, (n, len(self.D)))
        s = 1j * np.asarray(w, float)[:, None, None]
        states = np.linalg.solve(s * np.eye(n) - A, np.broadcast_to(B + 0j, (len(s), *B.shape)))
        return np.array(self.C) @ states + np.array(self.D) if n else np.tile(np.array(self.D) + 0j, (len(s), 1))

    def steady(self, w: Sequence[Array]) -> tuple[Array, ...]:
        """Return the n states for constant inputs w (in metres). Modes slower than SLOWEST (integrators) are 0."""
        return tuple(_sum(row, w) for row in _steady_states(self))

    def output(self, x: Sequence[Array], w: Sequence[Array]) -> Array:
        """Return y (a current in A or a voltage in V) for the n states x and the inputs w (in metres)."""
        return _sum(self.C, x) + _sum(self.D, w)

    def rates(self, x: Sequence[Array], w: Sequence[Array]) -> tuple[Array, ...]:
        """Return the rates of the n states for the states x and the inputs w (in metres)."""
        return tuple(_sum(a, x) + _sum(b, w) for a, b in zip(self.A, self.B, strict=True))

    def step(self, x: Sequence[Array], w: Sequence[Array], period: Scalar) -> tuple[Array, tuple[Array, ...]]:
        """Return y and the next state of the bilinear (Tustin) transform of the controller.

        With h = T/2 and the solution p of (I - h A) p = x + h B w: y = C p + D w, x+ = 2 p - x. Back substitution
        solves for p, in blocks of one row, or two rows for a pair of complex poles.
        """
        h = jnp.asarray(period) / 2
        p: list[Array] = [jnp.zeros(())] * len(self.A)
        for rows in reversed(self._blocks()):
            after = rows[-1] + 1
            right = [x[k] + h * (_sum(self.B[k], w) + _sum(self.A[k][after:], p[after:])) for k in rows]
            if len(rows) == 1:
                p[rows[0]] = right[0] / (1 - h * self.A[rows[0]][rows[0]])
                continue
            (a, b), (c, d) = (self.A[k][rows[0] : after] for k in rows)
            over = 1 / ((1 - h * a) * (1 - h * d) - h * h * (b * c))
            p[rows[0]] = over * ((1 - h * d) * right[0] + h * b * right[1])
            p[rows[1]] = over * ((1 - h * a) * right[1] + h * c * right[0])
        return self.output(p, w), tuple(2 * q - y for q, y in zip(p, x, strict=True))

    def _blocks(self) -> list[tuple[int, ...]]:
        blocks, k = [], 0
        while k < len(self.A):
            size = 2 if k + 1 < len(self.A) and self.A[k + 1][k] else 1
            blocks.append(tuple(range(k, k + size)))
            k += size
        return blocks


@functools.cache
def _steady_states(of: Realisation) -> tuple[Row, ...]:
    n = len(of.A)
    return tuple(map(tuple, steady_states(np.reshape(of.A, (n, n)), np.reshape(of.B, (n, len(of.D)))).tolist()))


def steady_states(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the matrix [n, m] from constant inputs to the steady state of the modes faster than SLOWEST."""
    n = len(A)
    if not n:
        return np.zeros(B.shape)
    import scipy.linalg

    parts: Any = scipy.linalg.schur(A, sort=lambda re, im: np.hypot(re, im) > SLOWEST)
    T, Q, fast = parts
    b = Q.T @ B
    # (I, Y; 0, I) separates the fast modes from the slow ones
    Y = np.zeros((fast, n - fast))
    if 0 < fast < n:
        Y = scipy.linalg.solve_sylvester(T[:fast, :fast], -T[fast:, fast:], -T[:fast, fast:])
    return -Q[:, :fast] @ np.linalg.solve(T[:fast, :fast], b[:fast] - Y @ b[fast:])


def _sum(row: Row, x: Sequence[Array]) -> Array:
    """Return the sum of the products. Terms with a coefficient of 0 add no operations to the compiled program."""
    total: Array | None = None
    for factor, value in zip(row, x, strict=True):
        if factor:
            total = factor * value if total is None else total + factor * value
    return jnp.zeros(()) if total is None else total


def realisation(
    A: npt.ArrayLike, B: npt.ArrayLike, C: npt.ArrayLike, D: npt.ArrayLike, dt: npt.ArrayLike | None = 0.0
) -> Realisation:
    """Return the realisation of a state space: A [n, n], B [n, m], C [1, n], D [1, m] with m = 1 or 2 inputs.

    `dt`: sample period, s; 0 or None: continuous. Raises ValueError if the shapes of the matrices do not match,
    if a number is not finite, if n exceeds MOST_STATES, if `dt` is invalid, or if a discrete controller has a pole near
    z = -1.
    """
    (a, b, c, d), step = continuous((A, B, C, D), dt)
    a, b, c = _scaled(*_triangular(a, b, c))
    _require_finite(a, b, c, d)
    rows = [tuple(map(tuple, x.tolist())) for x in (a, b)]
    return Realisation(rows[0], rows[1], tuple(c[0].tolist()), tuple(d[0].tolist()), step)


def continuous(
    matrices: Sequence[npt.ArrayLike], dt: npt.ArrayLike | None, outputs: int = 1
) -> tuple[tuple[np.ndarray, ...], float]:
    """Return A, B, C, D of the controller in continuous time, balanced, and its sample period (s; 0: continuous).

    For a discrete controller, they are those whose bilinear transform with this period it is. Raises ValueError as
    `realisation` does.
    """
    step = _period(dt)
    a, b, c, d = _shaped(outputs, *(_numbers(name, x) for name, x in zip("ABCD", matrices, strict=True)))
    a, b, c = _balanced(a, b, c)
    return (_continued(a, b, c, d, step) if step else (a, b, c, d)), step


def several(
    matrices: Sequence[npt.ArrayLike], dt: npt.ArrayLike | None, outputs: int
) -> tuple[tuple[np.ndarray, ...], np.ndarray, float]:
    """Return A, B, C, D of a controller of several outputs as `continuous` does, with scaled states.

    Also returns the states [n, m] in the steady state per constant input (`Realisation.steady`), and the period.
    """
    (a, b, c, d), step = continuous(matrices, dt, outputs)
    a, b, c = _scaled(a, b, c)
    _require_finite(a, b, c, d)
    return (a, b, c, d), steady_states(a, b), step


def _require_finite(*matrices: np.ndarray) -> None:
    if not all(np.isfinite(x).all() for x in matrices):
        raise ValueError("A, B, C: their numbers span too many decades. Balance the state space before saving it.")


def _period(dt: npt.ArrayLike | None) -> float:
    """Return the sample period, s; 0: continuous. Raises ValueError if `dt` is not a sample period, 0 or None."""
    x = np.zeros(()) if dt is None else np.asarray(dt)
    if x.dtype == bool:
        raise ValueError(f"dt = {dt}: a discrete controller needs a sample period. Give dt in seconds; 0: continuous.")
    if x.size != 1 or x.dtype.kind not in "iuf" or not 0 <= x.item() < np.inf:
        raise ValueError(f"dt = {dt}: it must be the sample period in seconds, or 0 for a continuous controller.")
    return float(x.item())


def _numbers(name: str, given: npt.ArrayLike) -> np.ndarray:
    """Return the array as floats. Raises ValueError unless it is a matrix of finite real numbers."""
    x = np.asarray(given)
    if x.dtype.kind not in "iuf":
        raise ValueError(f"{name} has entries of type {x.dtype}: it must contain real numbers.")
    if x.ndim > 2:
        raise ValueError(f"{name} has the shape {x.shape}: it must be a matrix.")
    if not np.isfinite(x).all():
        raise ValueError(f"{name} contains NaN or inf: all numbers must be finite.")
    return x.astype(float)


def _shaped(outputs: int, A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return A [n, n], B [n, m], C [outputs, n], D [outputs, m]. Raises ValueError if the given shapes do not match."""
    D = np.atleast_2d(D)
    if D.shape not in ((outputs, outputs), (outputs, 2 * outputs)):
        one, two = ((outputs, k * outputs) for k in (1, 2))
        raise ValueError(
            f"D has the shape {D.shape}: it must be {one}, for the input r - z, or {two}, for r and z"
            f"{'.' if outputs == 1 else f', of the {outputs} axes in order.'}"
        )
    n = 0 if not A.size else len(np.atleast_2d(A))
    most = MOST_STATES if outputs == 1 else MOST_OF_MACHINE
    if n > most:
        raise ValueError(f"A has {n} rows: a controller may have at most {most} states. Reduce its order.")
    made = []
    for name, x, shape in (("A", A, (n, n)), ("B", B, (n, D.shape[1])), ("C", C, (outputs, n))):
        if x.shape != shape and (x.size != shape[0] * shape[1] or (x.ndim == 2 and x.size)):
            raise ValueError(
                f"{name} has the shape {x.shape}: with {n} rows of A and D of shape {D.shape} it must be {shape}."
            )
        made.append(x.reshape(shape))
    return (*made, D)


def _continued(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the continuous state space that the bilinear transform with period dt (s) turns into this one."""
    one = np.eye(len(A))
    if len(A) and not np.linalg.cond(A + one) < MOST_CONDITION:
        raise ValueError(
            "A has an eigenvalue near -1: a bilinear transform has no pole at z = -1. Move this pole of the controller."
        )
    over = np.linalg.inv(A + one)
    return 2 / dt * (A - one) @ over, 2 / dt * over @ B, 2 * C @ over, D - C @ over @ B


def _balanced(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the state space with states scaled by powers of 2, so that rows and columns of A have similar norms."""
    if len(A) < 2:
        return A, B, C
    import scipy.linalg

    _, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    return A * scale / scale[:, None], B / scale[:, None], C * scale


def _triangular(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the state space with A in real Schur form."""
    if len(A) < 2:
        return A, B, C
    import scipy.linalg

    T, Q = scipy.linalg.schur(A, output="real")[:2]
    return T, Q.T @ B, C @ Q


def _scaled(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the state space with its states scaled by powers of 2, so that the largest response of each is near 1."""
    if not len(A):
        return A, B, C
    s = (FREQUENCIES * (1j + DAMPED))[:, None, None]
    states = np.linalg.solve(s * np.eye(len(A)) - A, np.broadcast_to(B + 0j, (len(s), *B.shape)))
    largest = np.max(np.abs(states), axis=(0, 2))
    size = np.exp2(np.round(np.log2(np.where(largest > 0, largest, 1.0))))
    return A * size / size[:, None], B / size[:, None], C * size
