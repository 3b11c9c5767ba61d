"""A shaft with discs as Timoshenko finite elements, reduced to its rigid motions and its first free bending modes.

Element matrices: H. D. Nelson, A finite rotating shaft element using Timoshenko beam theory, J. Mech. Des. 102 (1980).
Shear coefficient: G. R. Cowper, The shear coefficient in Timoshenko's beam theory, J. Appl. Mech. 33 (1966). All
functions are differentiable in lengths, diameters, materials and discs.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar


class Section(NamedTuple):
    """A cylindrical section of a shaft: lengths in m, `E` in Pa, `rho` in kg/m^3.

    `stiff`: 1; 0 for a sleeve, which has mass but does not stiffen the shaft. Its `begin` is its place on the shaft.
    """

    begin: Scalar
    length: Scalar
    outer: Scalar
    inner: Scalar
    E: Scalar
    rho: Scalar
    nu: Scalar
    stiff: Scalar = 1


class Disc(NamedTuple):
    """A rigid disc at a place of the shaft (m): mass (kg) and moments of inertia (kg m^2)."""

    at: Scalar
    m: Scalar
    I_t: Scalar
    I_p: Scalar


class ShaftModel(NamedTuple):
    """A shaft reduced to its rigid motions and k bending modes.

    - `m`, `I_t`, `I_p`: mass (kg) and moments of inertia (kg m^2). `centre`: place of the centre of mass, m.
    - `frequencies` [k]: of the free bending modes at rest, Hz.
    - `gyroscopic` [2 + k, 2 + k]: in q'' - j W gyroscopic q' + ..., q = (x + j y, tilt, modes), masses m, I_t, 1.
    - `shapes` [places, k]: mass-normalised shapes of the modes at the given places.
    """

    m: Array
    I_t: Array
    I_p: Array
    centre: Array
    frequencies: Array
    gyroscopic: Array
    shapes: Array


def shaft_model(
    sections: Sequence[Section], discs: Sequence[Disc], nodes: Array, sizes: Sequence[int], places: Sequence[int],
    modes: int,
) -> ShaftModel:  # fmt: skip
    """Return the reduced model.

    `nodes` [N]: places of the nodes, ascending, m; each end of a section, each disc and each place is a node. `sizes`:
    number of the section of each element, N - 1 entries per layer of sections that cover the shaft, -1 for none.
    `places`: numbers of the nodes at which the shapes are returned. `modes`: number of bending modes.
    """
    count = len(nodes)
    numbers = np.asarray(sizes, int).reshape(-1, count - 1)
    layers, at = np.nonzero(numbers >= 0)
    table = Section(*(jnp.asarray(field)[numbers[layers, at]] for field in zip(*sections, strict=True)))
    rows = 2 * at + np.arange(4)[:, None]
    M, G, K = (
        jnp.zeros((2 * count, 2 * count)).at[rows[:, None], rows[None]].add(x)
        for x in element(table, jnp.diff(nodes)[at])
    )
    for disc in discs:
        node = jnp.argmin(jnp.abs(nodes - disc.at))
        M = M.at[2 * node, 2 * node].add(disc.m).at[2 * node + 1, 2 * node + 1].add(disc.I_t)
        G = G.at[2 * node + 1, 2 * node + 1].add(disc.I_p)
    return reduced(M, G, K, nodes, [2 * place for place in places], modes)


def reduced(M: Array, G: Array, K: Array, nodes: Array, rows: Sequence[int], modes: int) -> ShaftModel:
    """Reduce the matrices of a free shaft in one plane to its rigid motions and its first bending modes.

    `M`, `G`, `K` [2 N, 2 N]: for (displacement, slope) at each node. `nodes` [N]: places, m. `rows`: coordinates at
    which the shapes are returned.
    """
    count = len(nodes)
    shift = jnp.stack([jnp.ones(count), jnp.zeros(count)], 1).ravel()
    m = shift @ M @ shift
    from_end = jnp.stack([nodes, jnp.ones(count)], 1).ravel()
    centre = shift @ M @ from_end / m
    tilt = from_end - centre * shift
    # bending: eigenvectors of L^-1 K L^-T with M = L L^T; the first two eigenvalues are those of the rigid motions
    lower = jnp.linalg.cholesky(M)
    half = jnp.linalg.solve(lower, K)
    values, vectors = jnp.linalg.eigh(jnp.linalg.solve(lower, half.T))
    bending = jnp.linalg.solve(lower.T, vectors[:, 2 : 2 + modes])
    bending = bending * jnp.where(bending[0] < 0, -1.0, 1.0)
    basis = jnp.concatenate([shift[:, None], tilt[:, None], bending], 1)
    return ShaftModel(
        m, tilt @ M @ tilt, tilt @ G @ tilt, centre, jnp.sqrt(values[2 : 2 + modes]) / (2 * jnp.pi),
        basis.T @ G @ basis, bending[jnp.asarray(rows, int)] if rows else jnp.zeros((0, modes)),
    )  # fmt: skip


def element(section: Section, length: Scalar) -> tuple[Array, Array, Array]:
    """Return mass, gyroscopic and stiffness matrix [4, 4] of an element, for (displacement, slope) at both ends.

    The numbers may be arrays [elements], and so are then the entries.
    """
    ratio, nu = section.inner / section.outer, section.nu
    area = jnp.pi / 4 * (section.outer**2 - section.inner**2)
    I = jnp.pi / 64 * (section.outer**4 - section.inner**4)
    hollow = (1 + ratio**2) ** 2
    shear = 6 * (1 + nu) * hollow / ((7 + 6 * nu) * hollow + (20 + 12 * nu) * ratio**2)
    # 12 E I / (shear G A l^2), G = E / (2 (1 + nu))
    phi = 24 * (1 + nu) * I / (shear * area * length**2)

    def matrix(a: Scalar, b: Scalar, c: Scalar, d: Scalar, e: Scalar, f: Scalar) -> Array:
        b, d, e, f = b * length, d * length, e * length**2, f * length**2
        entries = jnp.broadcast_arrays(a, b, c, -d, b, e, d, -f, c, d, a, -b, -d, -f, -b, e)
        return jnp.stack(entries).reshape(4, 4, *entries[0].shape)

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
