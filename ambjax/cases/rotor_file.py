"""Rotors in files: matrices of finite elements, as ROSS's `save_mat` writes them, or a modal table (.npz or .mat)."""

import pathlib
from functools import partial

import numpy as np

from ambjax.cases.named_files import contents_of
from ambjax.cases.rotor_body import DAMPING, MODES, RotorBody, dampings_of
from ambjax.cases.table import Table
from ambjax.world.shaft import reduced

MATRICES, TABLE, SHAPES = ("M", "K", "G", "nodes"), ("f_hz", "m", "It", "Ip", "zc"), "phi_"
# Largest stiffness against a rigid motion, relative to the largest entry of K: above it, the rotor is not free.
FREE = 1e-10
# Largest difference between the planes x and y, relative to the largest entry.
ALIKE = 1e-9
# Coordinates of a node: x and the tilt about y, y and the tilt about x, which has the opposite sign.
PLANES = {4: ((0, 3), (1, 2)), 6: ((0, 4), (1, 3))}
# Longest distance between the nodes beside a place, as a share of the length.
CLOSE = 0.1
# Largest distance between a place and the one at which a modal table has shapes, as a share of its length.
SAME = 1e-3


def body_of_file(table: Table, folder: pathlib.Path) -> RotorBody:
    """Return the rotor of the file that the key `file` names. Raises ValueError, one line, if something is wrong."""

    def body(found: dict[str, np.ndarray]) -> RotorBody:
        arrays = {name: x for name, x in found.items() if not name.startswith("_")}
        kind, names = (_of_table, TABLE) if "f_hz" in arrays else (_of_matrices, MATRICES)
        if missing := [name for name in names if name not in arrays]:
            raise ValueError(
                f"the array {missing[0]} is missing. It must contain M, K, G, nodes and, optionally, C or D, as the "
                f"save_mat of ROSS writes them; or f_hz, m, It, Ip, zc, shapes phi_NAME and, optionally, G, a modal "
                f"table. It has {', '.join(arrays) or 'none'}."
            )
        for name, x in arrays.items():
            if not (np.issubdtype(x.dtype, np.number) and np.isrealobj(x) and np.all(np.isfinite(x))):
                raise ValueError(f"{name} must contain finite real numbers.")
        return kind({name: np.asarray(x, float) for name, x in arrays.items()}, table)

    return contents_of(table, folder, body).contents


def _shaped(arrays: dict[str, np.ndarray], name: str, *shape: int) -> np.ndarray:
    """Return an array of a shape; a .mat file holds a vector as a row or a column."""
    x = arrays[name]
    if len(shape) < 2 and x.size == np.prod(shape, dtype=int):
        return x.reshape(shape)
    if x.shape != shape:
        raise ValueError(f"{name} has the shape {x.shape}: it must be {shape or 'one number'}.")
    return x


def _in_a_plane(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return M, K, G and, if there is one, the damping C of one plane, for (displacement, slope) at each node."""
    count, size = arrays["nodes"].size, len(arrays["M"])
    if size not in (4 * count, 6 * count):
        raise ValueError(f"M has {size} rows: {count} nodes need {4 * count} or {6 * count}, 4 or 6 a node.")
    own = size // count
    x, y = ((own * np.arange(count)[:, None] + np.array(pair)).ravel() for pair in PLANES[own])
    sign = np.tile([1.0, -1.0], count)  # a slope in y is a tilt about x with the opposite sign

    def plane(name: str) -> np.ndarray:
        whole = _shaped(arrays, name, size, size)
        first, second = whole[np.ix_(x, x)], whole[np.ix_(y, y)] * np.outer(sign, sign)
        if np.abs(first - second).max() > ALIKE * np.abs(whole).max():
            raise ValueError(f"{name} differs between the planes x and y, and the rotor must be the same in both.")
        return (first + first.T) / 2

    found = {name: plane(name) for name in ("M", "K")}
    if damping := [name for name in ("C", "D") if name in arrays]:
        found["C"] = plane(damping[0])
    return found | {"G": _shaped(arrays, "G", size, size)[np.ix_(x, y)] * sign}


def _of_matrices(arrays: dict[str, np.ndarray], table: Table) -> RotorBody:
    nodes = arrays["nodes"].ravel()
    count = len(nodes)
    if count < 2 or np.any(np.diff(nodes) <= 0):
        raise ValueError("nodes must be at least two places along the shaft, m, in ascending order.")
    own = _in_a_plane(arrays)
    K, slopes = own["K"], np.stack([nodes - nodes.mean(), np.ones(count)], 1).ravel()
    for motion in (np.tile([1.0, 0.0], count), slopes):
        if np.abs(K @ motion).max() > FREE * np.abs(K).max() * np.abs(motion).max():
            advice = "Save the rotor without bearings and seals, with nodes in m."
            raise ValueError(f"K holds the rotor: it must be free. {advice}")
    if np.linalg.eigvalsh(own["M"])[0] <= 0:
        raise ValueError("M must be positive definite.")
    modes = table.leaf("modes", MODES, MODES.default)
    if modes > 2 * count - 2:
        raise ValueError(f"{count} nodes have {2 * count - 2} bending modes, and {table.at('modes')} = {modes}.")
    model = reduced(own["M"], own["G"], K, nodes, modes)
    if model.I_p < 0:
        raise ValueError("G has the opposite sign: G[tilt about x, tilt about y] must be the polar inertia.")
    shapes, dampings = model.shapes, np.full(modes, DAMPING.default)
    if "C" in own:
        dampings = np.sum(shapes * (own["C"] @ shapes), 0) / (4 * np.pi * model.frequencies)
    at = partial(_interpolated, nodes, shapes)
    return RotorBody(*model[:5], dampings_of(table, dampings), model.gyroscopic, at)


def _interpolated(nodes: np.ndarray, shapes: np.ndarray, place: float) -> np.ndarray:
    """Return the shapes at a place: the cubic of displacements and slopes at the nodes beside it."""
    begin, length = nodes[0], nodes[-1] - nodes[0]
    if not -1e-9 * length <= place - begin <= (1 + 1e-9) * length:
        raise ValueError(f"rotor: the place {place:g} m is not on the shaft, {begin:g} to {nodes[-1]:g} m.")
    k = min(max(int(np.searchsorted(nodes, place)) - 1, 0), len(nodes) - 2)
    step = nodes[k + 1] - nodes[k]
    s = min(max((place - nodes[k]) / step, 0.0), 1.0)
    if step > CLOSE * length and min(s, 1 - s) > 1e-6:
        raise ValueError(
            f"rotor: the place {place:g} m is between the nodes at {nodes[k]:g} and {nodes[k + 1]:g} m, which are too "
            "far apart. Save the rotor with a node there."
        )
    cubic = [1 - 3 * s**2 + 2 * s**3, step * s * (1 - s) ** 2, 3 * s**2 - 2 * s**3, -step * s**2 * (1 - s)]
    return np.array(cubic) @ shapes[2 * k : 2 * k + 4]


def _of_table(arrays: dict[str, np.ndarray], table: Table) -> RotorBody:
    m, I_t, I_p, centre = (float(_shaped(arrays, name)) for name in TABLE[1:])
    if not (m > 0 and I_t > 0 and 0 <= I_p <= 2 * I_t):
        raise ValueError(f"m = {m:g}, It = {I_t:g}, Ip = {I_p:g}: m and It must be above 0, and Ip from 0 to 2 It.")
    f = arrays["f_hz"].ravel()
    count, scale = len(f), np.array([np.sqrt(m), np.sqrt(I_t)])
    if count < 2 or np.any(f[:2]) or np.any(f[2:] <= 0):
        raise ValueError("f_hz must be 0 for translation and tilt, and above 0 for the bending modes that follow.")
    names = [name for name in arrays if name.startswith(SHAPES)]
    if not names:
        raise ValueError("there are no shapes: give phi_NAME for each magnet and sensor.")
    rows = np.stack([_shaped(arrays, name, count) for name in names])
    for name, own in zip(names, rows, strict=True):
        if abs(own[0] * scale[0] - 1) > 1e-3:
            raise ValueError(f"{name}[0] = {own[0]:g}: shapes are mass-normalised, so it must be {1 / scale[0]:g}.")
    modes = table.leaf("modes", MODES) if "modes" in table.raw else count - 2
    if modes > count - 2:
        raise ValueError(f"it has {count - 2} bending modes, and {table.at('modes')} = {modes}.")
    places, kept = centre + rows[:, 1] * scale[1], slice(2, 2 + modes)
    gyroscopic = _gyroscopic_of(arrays, scale, I_p)[: 2 + modes, : 2 + modes]
    dampings = np.full(modes, DAMPING.default)
    if "damping" in arrays:
        dampings = _shaped(arrays, "damping", count)[kept]

    def at(place: float) -> np.ndarray:
        nearest = int(np.argmin(np.abs(places - place)))
        if abs(places[nearest] - place) > SAME * max(np.ptp(places), 1e-3):
            known = ", ".join(f"{x:.4g}" for x in np.unique(places.round(6)))
            raise ValueError(f"rotor: {table.raw['file']} has no shapes at {place:g} m. It has them at {known} m.")
        return rows[nearest, kept]

    return RotorBody(m, I_t, I_p, centre, f[kept], dampings_of(table, dampings), gyroscopic, at)


def _gyroscopic_of(arrays: dict[str, np.ndarray], scale: np.ndarray, I_p: float) -> np.ndarray:
    """Return the gyroscopic matrix of a modal table. `scale`: square roots of mass and inertia."""
    count = arrays["f_hz"].size
    found, weights = np.zeros((count, count)), np.concatenate([scale, np.ones(count - 2)])
    if "G" in arrays:
        found = _shaped(arrays, "G", count, count) * np.outer(weights, weights)
        found[0], found[:, 0] = 0.0, 0.0  # translation has no gyroscopic terms, apart from rounding
        if not np.allclose(found, found.T, atol=1e-9 * np.abs(found).max()):
            raise ValueError("G must be symmetric.")
        if not np.isclose(found[1, 1], I_p, rtol=1e-3):
            raise ValueError(f"G[1, 1] It = {found[1, 1]:g}: it must be Ip = {I_p:g} kg m^2.")
    found[1, 1] = I_p
    return found
