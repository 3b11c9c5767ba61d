"""Readers of [rotor], [[bearing]], [[unbalance]], [[load]] and [[base]] of a machine: the rotor and its axes."""

import itertools
import math
import pathlib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.cases.named_files import CaseFiles
from ambjax.cases.rotor_body import (
    DAMPING,
    FREQUENCY,
    I_P,
    I_T,
    MASS,
    MODES,
    PLACE,
    RotorBody,
    base_from,
    dampings_of,
    load_from,
    needed,
    row,
    unbalance_from,
    vector,
)
from ambjax.cases.rotor_file import body_of_file
from ambjax.cases.speed_table import speed_of
from ambjax.cases.table import Table, show
from ambjax.numerics.records import leaf
from ambjax.world.rotor import Rotor
from ambjax.world.shaft import Disc, Section, shaft_model

KINDS = ["rigid", "modal", "shaft"]
COORDINATES = ("x", "y", "z", "beta_x", "beta_y")
RIGID = len(COORDINATES)
# Tables that describe one axis, which each bearing may change.
OWN = ("plant", "controller", "sensor", "actuator", "reference")
# Keys of a bearing: the places of its magnet, sensor and stop, and the shapes of the modes there.
PLACE_KEYS, SHAPE_KEYS = ("at", "sensor_at", "stop_at"), ("modes", "sensor_modes", "stop_modes")
# Longest finite element, as a share of the shaft's length: bending frequencies are then correct to 1e-5.
LONGEST_ELEMENT = 1 / 70
# Largest rounding of the moments of inertia in a table.
PRINTED = 1e-2
ANGLE = leaf(default=0.0, unit="degrees", at_least=-360.0, at_most=360.0, doc="angle of the first axis from x")
LENGTH = leaf(unit="m", at_least=1e-6, at_most=100.0, doc="length of a section")
DIAMETER = leaf(unit="m", at_least=1e-6, at_most=100.0, doc="outer diameter of a section")
INNER = leaf(default=0.0, unit="m", at_least=0.0, at_most=100.0, doc="inner diameter of a section")
MATERIAL = {
    "E": leaf(default=2.1e11, unit="Pa", at_least=1e6, at_most=1e13, doc="Young's modulus"),
    "rho": leaf(default=7850.0, unit="kg/m^3", at_least=100.0, at_most=1e5, doc="density"),
    "nu": leaf(default=0.3, unit="1", at_least=0.0, at_most=0.5, doc="Poisson's ratio"),
}


class BearingAxis(NamedTuple):
    """One axis of a bearing: its name, the bearing's number, and the rows of its magnet, sensor and stop, each [n]."""

    name: str
    bearing: int
    magnet: np.ndarray
    sensor: np.ndarray
    stop: np.ndarray


def body_from(top: Table, folder: pathlib.Path = pathlib.Path()) -> RotorBody:
    """Return the masses and modes of [rotor]. `folder`: that of the case file."""
    table = top.table("rotor")
    kind = table.choice("kind", KINDS)
    common = ["kind", "gravity", "speed", "acceleration"]
    known = next((key for key in ("m", "I_t", "I_p") if key in table.raw), None)
    if known and (kind == "shaft" or "file" in table.raw):
        source = "geometry" if kind == "shaft" else "file"
        raise table.refuse(known, f"it follows from the {source}. Leave it out.")
    if kind == "shaft":
        table.only([*common, "elements", "discs", "sleeves", "modes", "damping", *MATERIAL])
        return _shaft(table, _places(top))
    if kind == "modal" and "file" in table.raw:
        table.only([*common, "file", "modes", "damping"])
        return body_of_file(table, folder)
    table.only([*common, "m", "I_t", "I_p", *(["modes", "Gm"] if kind == "modal" else [])])
    m, I_t, I_p = needed(table, "m", MASS), needed(table, "I_t", I_T), needed(table, "I_p", I_P)
    if I_t == 0:
        raise ValueError(f"{table.at('I_t')} = 0: it must be above 0 kg m^2.")
    _check_inertias(table, I_t, I_p)
    if kind == "modal" and "modes" not in table.raw:
        raise ValueError(
            f"{table.at('modes')} is missing: give [[rotor.modes]] with the frequency of each bending mode, or "
            'a file; kind = "rigid" has no modes.'
        )
    modes = table.tables("modes")
    for one in modes:
        one.only(["frequency", "damping"])
    frequencies = np.array([needed(one, "frequency", FREQUENCY) for one in modes])
    dampings = np.array([one.leaf("damping", DAMPING, DAMPING.default) for one in modes])
    return RotorBody(m, I_t, I_p, 0.0, frequencies, dampings, _gyroscopic(table, (m, I_t, I_p), len(modes)), None)


def _check_inertias(table: Table, I_t: float, I_p: float) -> None:
    if I_p > 2 * I_t * (1 + PRINTED):
        raise ValueError(f"{table.at('I_p')} = {I_p:g}: it must be at most 2 I_t = {2 * I_t:g} kg m^2, as of a disc.")


def _gyroscopic(table: Table, masses: tuple[float, float, float], modes: int) -> np.ndarray:
    """Return the gyroscopic matrix of translation, tilt and modes. `masses`: m, I_t, I_p.

    `Gm` covers the modes, or all coordinates. It is that of mass-normalised coordinates.
    """
    m, I_t, I_p = masses
    whole = np.zeros((2 + modes, 2 + modes))
    whole[1, 1] = I_p
    if "Gm" not in table.raw:
        return whole
    given = table.array("Gm", None, "a list of rows")
    Gm = np.asarray(given, float) if np.shape(given) in ((modes, modes), whole.shape) else np.full((1, 1), np.nan)
    if not np.all(np.isfinite(Gm)):
        whole_size = f"{2 + modes} rows of {2 + modes}, for translation, tilt and modes"
        raise table.refuse("Gm", f"it must be {modes} rows of {modes} numbers, for the modes, or {whole_size}.")
    if not np.allclose(Gm, Gm.T, rtol=1e-6, atol=1e-9 * np.abs(Gm).max()):
        raise ValueError(f"{table.at('Gm')}: it must be symmetric.")
    if len(Gm) == modes:
        whole[2:, 2:] = Gm
    elif np.abs(Gm[0]).max() > 1e-9 * np.abs(Gm).max() or not np.isclose(Gm[1, 1], I_p / I_t, rtol=1e-2):
        why = f"its first row must be 0, and Gm[1][1] = {Gm[1, 1]:g} must be I_p/I_t = {I_p / I_t:g}."
        raise ValueError(f"{table.at('Gm')}: {why}")
    else:
        size = np.sqrt([m, I_t, *np.ones(modes)])
        whole = Gm * np.outer(size, size)
    return whole


def _places(top: Table) -> list[float]:
    found = [
        one.leaf(key, PLACE)
        for name in ("bearing", "unbalance", "load")
        for one in top.tables(name)
        for key in PLACE_KEYS
        if key in one.raw
    ]
    return [*found, 0.0]


def _section(table: Table, begin: float, common: Table, sleeve: bool = False) -> Section:
    table.only(["length", "diameter", "inner_diameter", *MATERIAL, *(["at"] if sleeve else [])])
    material = [table.leaf(name, field, common.leaf(name, field, field.default)) for name, field in MATERIAL.items()]
    outer, inner = needed(table, "diameter", DIAMETER), table.leaf("inner_diameter", INNER, 0.0)
    if inner >= outer:
        raise ValueError(f"{table.at('inner_diameter')} = {inner:g} m: it must be below the diameter, {outer:g} m.")
    E, rho, nu = material
    return Section(begin, needed(table, "length", LENGTH), outer, inner, E, rho, nu, not sleeve)


def _shaft(table: Table, places: list[float]) -> RotorBody:
    """Return the body of a shaft from its geometry. Places are measured from the left end of the shaft."""
    elements, begin, sections = table.tables("elements"), 0.0, list[Section]()
    if not elements:
        raise ValueError(f"{table.at('elements')} is missing: give [[rotor.elements]] with length and diameter.")
    for one in elements:
        sections.append(_section(one, begin, table))
        begin += float(sections[-1].length)
    end = begin
    for one in table.tables("sleeves"):
        sections.append(_section(one, needed(one, "at", PLACE), table, sleeve=True))
    discs = []
    for one in table.tables("discs"):
        one.only(["at", "m", "I_t", "I_p"])
        discs.append(Disc(*(needed(one, k, f) for k, f in (("at", PLACE), ("m", MASS), ("I_t", I_T), ("I_p", I_P)))))
        _check_inertias(one, float(discs[-1].I_t), float(discs[-1].I_p))
    ends = [x for one in sections for x in (one.begin, one.begin + one.length)]
    for place in (*places, *ends, *(disc.at for disc in discs)):
        if not -1e-9 <= place <= end * (1 + 1e-9):
            where = f"is not on the shaft, which is {end:g} m long from its left end."
            raise ValueError(f"rotor: the place {place:g} m {where}")
    points = _distinct([*places, *ends, *(disc.at for disc in discs)], 1e-6 * end)
    nodes = _distinct(
        [x for a, b in itertools.pairwise(points)
         for x in np.linspace(a, b, max(1, math.ceil((b - a) / (LONGEST_ELEMENT * end) - 1e-9)) + 1)], 1e-6 * end,
    )  # fmt: skip
    count = table.leaf("modes", MODES, MODES.default)
    model = shaft_model(sections, discs, nodes, count)

    def at(place: float) -> np.ndarray:
        return model.shapes[2 * int(np.argmin(np.abs(nodes - place)))]

    return RotorBody(*model[:5], dampings_of(table, np.full(count, DAMPING.default)), model.gyroscopic, at)


def _distinct(x: Any, close: float) -> np.ndarray:
    """Return the values in ascending order, without those that are within `close` of the one before."""
    x = np.sort(np.asarray(x, float))
    return x[np.concatenate([[True], np.diff(x) > close])]


def axes_from(bearings: list[Table], body: RotorBody) -> list[BearingAxis]:
    """Return the axes of all bearings: of a radial one those of `axes`, at `angle` and 90 degrees further; or z."""
    axes, seen = [], set()
    for number, table in enumerate(bearings):
        own = [] if body.shapes is not None else SHAPE_KEYS
        table.only(["name", "kind", *PLACE_KEYS, "axes", "angle", "clearance", *own, *OWN])
        kind = table.choice("kind", ["radial", "axial"])
        name = table.raw.get("name", f"bearing{number + 1}")
        if not isinstance(name, str) or not name or "." in name or name in seen:
            why = "each bearing needs a name of its own, as text without dots, which separate the words of paths."
            raise ValueError(f"{table.at('name')} = {show(name)}: {why}")
        seen.add(name)
        if kind == "axial":
            _check_axial(table)
            none = np.zeros(len(body.frequencies))
            z = row(0.0, (0.0, 0.0, 1.0), none)
            axes.append(BearingAxis(f"{name}.z", number, z, z, z))
            continue
        at = needed(table, "at", PLACE)
        if body.shapes is None and len(body.frequencies):
            vector(table, "modes", len(body.frequencies))  # a radial bearing gives the shapes at its magnet
        magnet, others = body.place(table), zip(PLACE_KEYS[1:], SHAPE_KEYS[1:], strict=True)
        places = [magnet, *(body.place(table, *keys, (at, magnet[1])) for keys in others)]
        angle = math.radians(table.leaf("angle", ANGLE, 0.0))
        cos, sin = _exact(math.cos(angle)), _exact(math.sin(angle))
        directions = {"x": (cos, sin, 0.0), "y": (-sin, cos, 0.0)}
        for label in _labels(table, list(directions)):
            rows = [row(place, directions[label], shapes) for place, shapes in places]
            axes.append(BearingAxis(f"{name}.{label}", number, *rows))
    return axes


def _check_axial(table: Table) -> None:
    """Raise ValueError for a key that an axial bearing cannot use. Its places are checked, but have no effect."""
    for key in ("axes", "angle", *SHAPE_KEYS):
        if key in table.raw:
            raise ValueError(f"{table.at(key)}: an axial bearing acts along the shaft, without bending. Omit {key}.")
    for key in PLACE_KEYS:
        table.leaf(key, PLACE, 0.0)


def _labels(table: Table, known: list[str]) -> list[str]:
    """Return the labels of the axes of a radial bearing."""
    found = table.raw.get("axes", known)
    if found not in (known, *([one] for one in known)):
        raise table.refuse("axes", f"it must be {', '.join(show([one]) for one in known)} or {show(known)}.")
    return list(found)


def _exact(x: float) -> float:
    """Return x, or the whole number within rounding of it, so that axes along x and y are uncoupled."""
    return float(round(x)) if abs(x - round(x)) < 1e-15 else x


def rotor_from(top: Table, body: RotorBody, axes: list[BearingAxis], folder: pathlib.Path) -> Rotor:
    """Return the rotor of the tables [rotor], [[unbalance]], [[load]] and [[base]]."""
    table, k = top.table("rotor"), len(body.frequencies)
    unbalances = top.tables("unbalance")
    graded = sum("grade" in one.raw for one in unbalances)
    n, w = RIGID + 2 * k, 2 * np.pi * np.repeat(body.frequencies, 2)
    mass = np.concatenate([[body.m, body.m, body.m, body.I_t, body.I_t], np.ones(2 * k)])
    K, D = np.zeros(n), np.zeros(n)
    K[RIGID:], D[RIGID:] = w**2, 2 * np.repeat(body.dampings, 2) * w
    # the complex coordinates x + j y, beta_y - j beta_x and the modes, as rows of real and imaginary parts
    unit = np.eye(n)
    real = np.stack([unit[0], unit[4], *unit[RIGID::2]])
    imaginary = np.stack([unit[1], -unit[3], *unit[RIGID + 1 :: 2]])
    G = real.T @ body.gyroscopic @ imaginary - imaginary.T @ body.gyroscopic @ real
    turning, gravity = speed_of(table), np.zeros(n)
    gravity[:3] = body.m * vector(table, "gravity", 3, (0.0, -9.81, 0.0))
    apart = any(np.any(axis.stop != axis.magnet) for axis in axes)
    return Rotor(
        M=jnp.diag(mass),
        D=jnp.diag(D),
        G=jnp.asarray(G),
        K=jnp.diag(K),
        at_magnets=jnp.stack([axis.magnet for axis in axes]),
        at_sensors=jnp.stack([axis.sensor for axis in axes]),
        at_stops=jnp.stack([axis.stop for axis in axes]) if apart else None,
        gravity=jnp.asarray(gravity),
        speed=turning.speed,
        acceleration=turning.acceleration,
        changes=turning.changes,
        unbalances=tuple(unbalance_from(one, body, graded) for one in unbalances),
        loads=tuple(load_from(one, body, CaseFiles(folder)) for one in top.tables("load")),
        base=tuple(base_from(one, n, CaseFiles(folder)) for one in top.tables("base")),
    )


def axes_and_rotor(top: Table, folder: pathlib.Path) -> tuple[list[BearingAxis], Rotor]:
    """Return the axes and the rotor of a case file."""
    body = body_from(top, folder)
    axes = axes_from(top.tables("bearing"), body)
    return axes, rotor_from(top, body, axes, folder)
