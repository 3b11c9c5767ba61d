"""A shaft with discs as Timoshenko finite elements, reduced to its rigid motions and its first free bending modes.

Element matrices: H. D. Nelson, A finite rotating shaft element using Timoshenko beam theory, J. Mech. Des. 102 (1980).
Shear coefficient: G. R. Cowper, The shear coefficient in Timoshenko's beam theory, J. Appl. Mech. 33 (1966).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np


class Section(NamedTuple):
    """A cylindrical section of a shaft: lengths in m, `E` in Pa, `rho` in kg/m^3.

    `stiff`: 1; 0 for a sleeve, which has mass but does not stiffen the shaft. Its `begin` is its place on the shaft.
    """

    begin: float
    length: float
    outer: float
    inner: float
    E: float
    rho: float
    nu: float
    stiff: float = 1


class Disc(NamedTuple):
    """A rigid disc at a place of the shaft (m): mass (kg) and moments of inertia (kg m^2)."""

    at: float
    m: float
    I_t: float
    I_p: float


class ShaftModel(NamedTuple):
    """A shaft reduced to its rigid motions and k bending modes.

    - `m`, `I_t`, `I_p`: mass (kg) and moments of inertia (kg m^2). `centre`: place of the centre of mass, m.
    - `frequencies` [k]: of the free bending modes at rest, Hz.
    - `gyroscopic` [2 + k, 2 + k]: in q'' - j W gyroscopic q' + ..., q = (x + j y, tilt, modes), masses m, I_t, 1.
    - `shapes` [2 N, k]: mass-normalised shapes of the modes: displacement and slope at each node.
    """

    m: float
    I_t: float
    I_p: float
    centre: float
    frequencies: np.ndarray
    gyroscopic: np.ndarray
    shapes: np.ndarray


def shaft_model(sections: Sequence[Section], discs: Sequence[Disc], nodes: np.ndarray, modes: int) -> ShaftModel:
    """Return the reduced model. `modes`: number of bending modes.

    `nodes` [N]: places of the nodes, ascending, m; each end of a section and each disc is a node.
    """
    lengths, middles = np.diff(nodes), (nodes[1:] + nodes[:-1]) / 2
    M, G, K = np.zeros((3, 2 * len(nodes), 2 * len(nodes)))
    for section in sections:
        at = np.flatnonzero((section.begin < middles) & (middles < section.begin + section.length))
        rows = 2 * at + np.arange(4)[:, None]
        for whole, own in zip((M, G, K), element(section, lengths[at]), strict=True):
            np.add.at(whole, (rows[:, None], rows[None]), own)
    for disc in discs:
        node = 2 * np.argmin(np.abs(nodes - disc.at))
        M[node, node] += disc.m
        M[node + 1, node + 1] += disc.I_t
        G[node + 1, node + 1] += disc.I_p
    return reduced(M, G, K, nodes, modes)


def reduced(M: np.ndarray, G: np.ndarray, K: np.ndarray, nodes: np.ndarray, modes: int) -> ShaftModel:
    """Reduce the matrices of a free shaft in one plane to its rigid motions and its first bending modes.

    `M`, `G`, `K` [2 N, 2 N]: for (displacement, slope) at each node. `nodes` [N]: places, m.
    """
    shift = np.tile([1.0, 0.0], len(nodes))
    from_end = np.stack([nodes, np.ones(len(nodes))], 1).ravel()
    centre = float(shift @ M @ from_end / (shift @ M @ shift))
    tilt = from_end - centre * shift
    m, I_t, I_p = (float(x @ matrix @ x) for x, matrix in ((shift, M), (tilt, M), (tilt, G)))
    # bending: eigenvectors of L^-1 K L^-T with M = L L^T; the first two eigenvalues are those of the rigid motions
    lower = np.linalg.cholesky(M)
    half = np.linalg.solve(lower, K)
    values, vectors = np.linalg.eigh(np.linalg.solve(lower, half.T))
    bending = np.linalg.solve(lower.T, vectors[:, 2 : 2 + modes])
    bending = bending * np.where(bending[0] < 0, -1.0, 1.0)
    basis = np.column_stack([shift, tilt, bending])
    with np.errstate(invalid="ignore"):  # rounding may make an eigenvalue of an extreme shaft negative
        frequencies = np.sqrt(values[2 : 2 + modes]) / (2 * np.pi)
    return ShaftModel(m, I_t, I_p, centre, frequencies, basis.T @ G @ basis, bending)


def element(section: Section, length: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mass, gyroscopic and stiffness matrix [4, 4] of an element, for (displacement, slope) at both ends.

    `length` may be an array [elements], and so are then the entries.
    """
    ratio, nu = section.inner / section.outer, section.nu
    area = np.pi / 4 * (section.outer**2 - section.inner**2)
    I = np.pi / 64 * (section.outer**4 - section.inner**4)
    hollow = (1 + ratio**2) ** 2
    shear = 6 * (1 + nu) * hollow / ((7 + 6 * nu) * hollow + (20 + 12 * nu) * ratio**2)
    # 12 E I / (shear G A l^2), G = E / (2 (1 + nu))
    phi = 24 * (1 + nu) * I / (shear * area * length**2)

    def matrix(a: Any, b: Any, c: Any, d: Any, e: Any, f: Any) -> np.ndarray:
        b, d, e, f = b * length, d * length, e * length**2, f * length**2
        entries = np.broadcast_arrays(a, b, c, -d, b, e, d, -f, c, d, a, -b, -d, -f, -b, e)
        return np.stack(entries).reshape(4, 4, *entries[0].shape)

    translation = matrix(
        13 / 35 + 7 * phi / 10 + phi**2 / 3,
        11 / 210 + 11 * phi / 120 + phi**2 / 24, 9 / 70 + 3 * phi / 10 + phi**2 / 6,
        13 / 420 + 3 * phi / 40 + phi**2 / 24, 1 / 105 + phi / 60 + phi**2 / 120, 1 / 140 + phi / 60 + phi**2 / 120,
    )  # fmt: skip
    slope = 1 / 10 - phi / 2
    rotation = matrix(6 / 5, slope, -6 / 5, -slope, 2 / 15 + phi / 6 + phi**2 / 3, 1 / 30 + phi / 6 - phi**2 / 6)
    bending = matrix(12.0, 6.0, -12.0, -6.0, 4 + phi, phi - 2)
    rotation = section.rho * I / (length * (1 + phi) ** 2) * rotation
    mass = section.rho * area * length / (1 + phi) ** 2 * translation + rotation
    stiffness = section.stiff * section.E * I / (length**3 * (1 + phi)) * bending
    return mass, 2 * rotation, stiffness
