"""One HTML page that shows the rotor of a machine in motion: its shape, magnified, and the orbits at its planes."""

import html
import importlib.resources
import json
import math
from typing import Any

import numpy as np

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.rotor_drawing import drawing_of, place_of, radial_axes
from ambjax.cases.rotor_tables import RIGID

# Largest number of instants, and their least number in a revolution. A longer run is shown from its end backwards.
MOST, PER_TURN = 2000, 16
DIGITS = 4


def motion_page(case: MachineCase, signals: dict[str, Any]) -> str:
    """Return the page of a run. `signals`: as in trajectory.npz."""
    data = json.dumps(motion_of(case, signals), separators=(",", ":")).replace("<", "\\u003c")
    page = (importlib.resources.files("ambjax.page") / "assets" / "motion.html").read_text(encoding="utf-8")
    return page.replace("{title}", html.escape(f"{case.name}: the rotor in motion")).replace("{data}", data)


def motion_of(case: MachineCase, signals: dict[str, Any]) -> dict[str, Any]:
    """Return the data of the page.

    `at`: places of the shaft, m. `along`: rows from the coordinates (translation, tilt, modes) of one plane to the
    displacement at each place. `x`, `y`: these coordinates at each time `t` (s). `planes`: kind and place. `rpm`:
    speed. `stops`: place and clearance (m) of the stop of each radial bearing.
    """
    drawing = drawing_of(case)
    t, speed, period = signals["t"], np.abs(signals["speed_rpm"]), float(case.clock.sample_period)
    turn = 60 / max(float(np.max(speed)), 1e-9)
    stride = max(1, min(math.ceil(len(t) / MOST), int(turn / (PER_TURN * period))))
    kept = np.arange(len(t) - 1, -1, -stride)[:MOST][::-1]
    q = np.nan_to_num(signals["q"][kept])
    modes = q[:, RIGID:].reshape(len(q), -1, 2)
    x = np.column_stack([q[:, 0], q[:, 4], modes[:, :, 0]])
    y = np.column_stack([q[:, 1], -q[:, 3], modes[:, :, 1]])
    rotor = case.machine.rotor
    rows = np.asarray(rotor.at_magnets if rotor.at_stops is None else rotor.at_stops)
    stops = {round(place_of(rows[k]), 6): float(case.cases[k].scenario.touchdown) for k in radial_axes(case)}
    return {
        "t": _rounded(t[kept]), "rpm": _rounded(speed[kept]), "x": _rounded(x), "y": _rounded(y),
        "at": _rounded(drawing.at), "stops": list(map(list, stops.items())),
        "along": _rounded(np.column_stack([np.ones_like(drawing.at), drawing.at, drawing.shapes])),
        "planes": [[kind, round(place, 6)] for kind, place in drawing.planes],
    }  # fmt: skip


def _rounded(x: np.ndarray) -> list[Any]:
    """Return an array as nested lists of numbers with a few significant digits."""
    return np.vectorize(lambda one: float(f"{one:.{DIGITS + 1}g}"), otypes=[float])(x).tolist()
