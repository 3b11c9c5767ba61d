"""What is drawn of a rotor: its outline, the planes of its parts, and the places at which its modes are known."""

import tomllib
from typing import NamedTuple

import numpy as np

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.rotor_tables import RIGID, body_from
from ambjax.cases.table import Table
from ambjax.world.rotor import Rotor

# Number of places at which a shaft is drawn.
PLACES = 71


class RotorDrawing(NamedTuple):
    """A rotor from the side. Places are measured from the centre of mass, m.

    - `planes`: kind ("magnet", "sensor", "stop" apart from its magnet, or "unbalance") and place.
    - `at` [P], `shapes` [P, k]: places, ascending, and shapes of the bending modes there.
    - `sections`: begin, end and diameter (m) of each section of a shaft. `discs`: places of its discs.
    """

    planes: tuple[tuple[str, float], ...]
    at: np.ndarray
    shapes: np.ndarray
    sections: tuple[tuple[float, float, float], ...] = ()
    discs: tuple[float, ...] = ()


def drawing_of(case: MachineCase) -> RotorDrawing:
    """Return the drawing of the rotor of a case. Only a shaft is known between the planes."""
    planes, shapes = zip(*_planes(case.machine.rotor), strict=True)
    places = np.array([at for _, at in planes])
    raw = tomllib.loads(case.text) if case.text else {}
    if raw.get("rotor", {}).get("kind") != "shaft":
        order = np.unique(places, return_index=True)[1]
        return RotorDrawing(planes, places[order], np.stack(shapes)[order])
    ends = np.cumsum([0.0, *(one["length"] for one in raw["rotor"]["elements"])])
    at = np.linspace(0.0, ends[-1], PLACES)
    top = Table(raw | {"load": [{"at": float(x)} for x in at]})  # so that each place is a node
    body, table = body_from(top), top.table("rotor")
    shape_at, diameters = body.shapes, [one.raw["diameter"] for one in table.tables("elements")]
    assert shape_at is not None
    sections = tuple(zip(ends[:-1] - body.centre, ends[1:] - body.centre, diameters, strict=True))
    discs = tuple(one.raw["at"] - body.centre for one in table.tables("discs"))
    return RotorDrawing(planes, at - body.centre, np.stack([shape_at(x) for x in at]), sections, discs)


def _planes(rotor: Rotor) -> list[tuple[tuple[str, float], np.ndarray]]:
    """Return kind, place and mode shapes of each plane of the rotor, without repetition."""
    magnets = np.asarray(rotor.at_magnets)
    stops = magnets if rotor.at_stops is None else np.asarray(rotor.at_stops)
    rows = [("magnet", row) for row in magnets]
    rows += [("sensor", row) for row in np.asarray(rotor.at_sensors)]
    rows += [("stop", row) for row in stops[np.any(stops != magnets, 1)]]
    rows += [("unbalance", np.asarray(one.along_x)) for one in rotor.unbalances]
    found: dict[tuple[str, float], np.ndarray] = {}
    for kind, row in rows:
        d, own = row[:2], row[RIGID:].reshape(-1, 2)
        if np.any(d):  # radial: the row of a displacement along d at l
            found.setdefault((kind, place_of(row)), own @ d / (d @ d))
    return list(found.items())


def radial_axes(case: MachineCase) -> list[int]:
    """Return the numbers of the axes across the shaft."""
    return [k for k, name in enumerate(case.axes) if not name.endswith(".z")]


def in_pairs(case: MachineCase) -> bool:
    """Return whether there are radial bearings, and each has two axes."""
    names = [case.axes[k].rpartition(".")[0] for k in radial_axes(case)]
    return len(names) == 2 * len(set(names)) > 0


def place_of(row: np.ndarray) -> float:
    """Return the place of the row [n] of a displacement across the shaft, m from the centre of mass."""
    d = row[:2]
    return round(float((row[4] * d[0] - row[3] * d[1]) / (d @ d)), 12)
