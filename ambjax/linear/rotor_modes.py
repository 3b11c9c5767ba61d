"""Modes of a whole machine: their names, directions and shapes; and the critical speeds of its rotor on springs."""

from typing import NamedTuple

import numpy as np

from ambjax.linear.linear_machine import TurningMachine
from ambjax.world.rotor import Rotor

# Coordinates of the rigid rotor.
RIGID = 5
# Share of the forward part of a motion, beyond one half, from which on the motion has a direction.
CIRCULAR = 0.05
# Damping ratio below which a mode counts as lightly damped.
LIGHT = 0.3
# Share of the rotor in a mode from which on the mode has the name of a motion. The rotor has about half of its modes if
# an observer copies its states, and less than a quarter of those of integrals, filters and delays.
LEAST = 0.3
# Names of the other modes: of coils, amplifiers and low-passes, and of the laws and the delay of their commands.
OTHERS = ("actuator", "controller")
# Size of a pole of the z-plane that is a pure delay, and relative size of an imaginary part that is a rounding error.
DELAY, REAL = 1e-9, 1e-6


class Mode(NamedTuple):
    """A pole with the motion of the rotor in it.

    - `pole`: 1/s, with a positive imaginary part. `name`: the motion with the largest share of the kinetic energy:
      "translation", "tilt", "axial" or "bending 1" and so on; one of OTHERS if the rotor has less than LEAST of it.
    - `whirl`: "forward" (as the rotor turns), "backward", "planar", or "" for an axial motion and for OTHERS.
    - `shape` [n]: coordinates, complex.
    """

    pole: complex
    name: str
    whirl: str
    shape: np.ndarray

    @property
    def frequency(self) -> float:
        """Frequency, Hz."""
        return self.pole.imag / (2 * np.pi)

    @property
    def damping(self) -> float:
        """Damping ratio."""
        return -self.pole.real / abs(self.pole)

    @property
    def label(self) -> str:
        """Name and direction."""
        return f"{self.name} {self.whirl}".strip()

    def numbers(self) -> dict[str, object]:
        """Return the mode as plain data."""
        return {
            "frequency_hz": self.frequency, "damping_ratio": self.damping, "growth_per_s": self.pole.real,
            "name": self.name, "whirl": self.whirl,
        }  # fmt: skip


def modes_of(point: TurningMachine, rotor: Rotor) -> list[Mode]:
    """Return the oscillating modes of a machine in the order of their frequencies."""
    system, sampled = point.system.without_idle().scaled(), point.system.period is not None
    A, n, masses = np.asarray(system.A), len(np.asarray(rotor.gravity)), np.diag(np.asarray(rotor.M))
    values, vectors = np.linalg.eig(A)
    lasting = np.abs(values) > DELAY * sampled
    values, vectors = values[lasting], vectors[:, lasting]
    moving = ~np.asarray(point.system.idle())
    shares = _shares(A, vectors, [int(moving[:end].sum()) for end in (2 * n, len(point.free))])
    # a negative real pole alternates from sample to sample: it is no oscillation of the rotor
    kept = (np.abs(np.imag(values)) > REAL * np.abs(values)) | (np.real(values) > 0) | (not sampled)
    if system.period is not None:
        values = np.log(values + 0j) / float(system.period)
    shapes, way, found = (np.asarray(system.C)[-n:] @ vectors).T, int(np.sign(point.W)), []
    for pole, share, shape in zip(values[kept], shares[kept], shapes[kept], strict=True):
        if pole.imag > REAL * abs(pole):
            words = _described(shape, masses, way) if share[0] >= LEAST else (OTHERS[int(np.argmax(share[1:]))], "")
            found.append(Mode(complex(pole), *words, shape))
    return sorted(found, key=lambda mode: mode.frequency)


def _shares(A: np.ndarray, vectors: np.ndarray, ends: list[int]) -> np.ndarray:
    """Return the shares of groups of states in modes [modes, groups]: sums of participation factors |w_i v_i|.

    `vectors` [N, modes]: right eigenvectors v of A, without those of pure delays, which need not be complete. The rows
    w of the left ones have w v = 1, and 0 with the other v. `ends`: numbers of the first states of the later groups.
    """
    values, left = np.linalg.eig(A.T)
    left = left[:, np.argsort(-np.abs(values))[: vectors.shape[1]]].T
    factors = np.abs(np.linalg.lstsq(left @ vectors, left, rcond=None)[0]).T * np.abs(vectors)
    return np.add.reduceat(factors, [0, *ends], axis=0).T / factors.sum(0)[:, None]


def planes_of(shape: np.ndarray) -> np.ndarray:
    """Return the pairs [2 + k, 2] of translation, tilt and bending, each as motions in x and y."""
    x, y, _, beta_x, beta_y = shape[:RIGID]
    return np.concatenate([[[x, y], [beta_y, -beta_x]], shape[RIGID:].reshape(-1, 2)])


def _described(shape: np.ndarray, masses: np.ndarray, way: int) -> tuple[str, str]:
    """Return name and direction of a motion. `way`: sign of the speed; at 0, the two planes of a mode are equal."""
    weights = np.concatenate([masses[[0, 3]], masses[RIGID::2]])
    pairs = planes_of(shape)
    energy = weights * np.sum(np.abs(pairs) ** 2, 1)
    if masses[2] * abs(shape[2]) ** 2 > energy.max():
        return "axial", ""
    k = int(np.argmax(energy))
    forward = np.sum(weights * np.abs(pairs[:, 0] + way * 1j * pairs[:, 1]) ** 2) / 2 / np.sum(energy)
    whirl = "planar" if not way or abs(forward - 0.5) < CIRCULAR else "forward" if forward > 0.5 else "backward"
    return ("translation", "tilt")[k] if k < 2 else f"bending {k - 1}", whirl


def springs_critical(rotor: Rotor, stiffness: np.ndarray) -> list[np.ndarray]:
    """Return the undamped critical speeds (rpm, ascending) of the rotor on springs at its radial magnets."""
    n = len(np.asarray(rotor.gravity))
    unit = np.eye(n, dtype=complex)
    # x = 1, y = -j; tilt: beta_y = 1, beta_x = j
    basis = np.stack([unit[0] - 1j * unit[1], unit[4] + 1j * unit[3], *(unit[RIGID::2] - 1j * unit[RIGID + 1 :: 2])], 1)
    rows = np.asarray(rotor.at_magnets)
    radial = rows[np.any(rows[:, :2] != 0, axis=1)]
    M, K, G, B = (
        np.real(basis.conj().T @ x @ basis) / 2
        for x in (np.asarray(rotor.M), np.asarray(rotor.K), 1j * np.asarray(rotor.G), radial.T @ radial)
    )
    found, held = [], np.any(K + B, 1)
    M, K, G, B = (x[np.ix_(held, held)] for x in (M, K, G, B))
    for k in stiffness:
        # K + k B - W^2 (M - G) is singular; without G it is positive definite
        inverse = np.linalg.eigvals(np.linalg.solve(K + k * B, M - G)).real
        found.append(np.sort(np.sqrt(1 / inverse[inverse > 1e-14 * inverse.max()])) * 30 / np.pi)
    return found
