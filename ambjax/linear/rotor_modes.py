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
# Size of a pole of the z-plane that is a pure delay, and relative size of an imaginary part that is a rounding error.
DELAY, REAL = 1e-9, 1e-6


class Mode(NamedTuple):
    """A pole with the motion of the rotor in it.

    - `pole`: 1/s, with a positive imaginary part. `name`: the motion with the largest share of the kinetic energy:
      "translation", "tilt", "axial" or "bending 1" and so on.
    - `whirl`: "forward" (as the rotor turns), "backward", "planar", or "" for an axial motion.
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
    system = point.system.without_idle().scaled()
    values, vectors = np.linalg.eig(np.asarray(system.A))
    if system.period is not None:
        # a negative real pole alternates from sample to sample: it is no oscillation of the rotor
        size = np.abs(values)
        kept = (size > DELAY) & ((np.abs(np.imag(values)) > REAL * size) | (np.real(values) > 0))
        values, vectors = np.log(values[kept] + 0j) / float(system.period), vectors[:, kept]
    n, masses = len(np.asarray(rotor.gravity)), np.diag(np.asarray(rotor.M))
    shapes = np.asarray(system.C)[-n:] @ vectors
    found = [
        Mode(complex(pole), *_described(shape, masses, int(np.sign(point.W))), shape)
        for pole, shape in zip(values, shapes.T, strict=True)
        if pole.imag > REAL * abs(pole)
    ]
    return sorted(found, key=lambda mode: mode.frequency)


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
    found = []
    for k in stiffness:
        # K + k B - W^2 (M - G) is singular; without G it is positive definite
        inverse = np.linalg.eigvals(np.linalg.solve(K + k * B, M - G)).real
        found.append(np.sort(np.sqrt(1 / inverse[inverse > 1e-14 * inverse.max()])) * 30 / np.pi)
    return found
