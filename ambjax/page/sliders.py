"""The sliders of the page: path, unit, meaning and range of each, and the parameter of the JavaScript that it sets."""

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np

from ambjax.cases.case_table import UNITS
from ambjax.cases.reader import Case
from ambjax.ensemble.paths import SHIFT, Place, places, with_values
from ambjax.page.loop_functions import longest_delay, loop_parameters

# The slider of a gain, a number of [actuator], a bandwidth or a sensor's range goes from the number divided by FACTOR
# to the number times FACTOR. The slider of a number of the plant, or of the sensor's gain, goes from 1 - SHARE to
# 1 + SHARE times the number.
FACTOR, SHARE = 30.0, 0.5
# The slider of any other number without a rule in `_range` ends at this multiple of its value (of `_size` if it is 0).
TIMES = 5.0
SEED = "run.seed"
# Prefix of the paths, and title, of each group, in the order of the page.
GROUPS = {
    "controller.": "Gains",
    "processor.": "Processor",
    "sensor.": "Sensors",
    "actuator.": "Supply and amplifier",
    "disturbance.": "Disturbance",
    "reference.": "Reference",
    "initial.": "Initial state",
    "run.": "Clearance and seed",
    "plant.": "True plant (the controller keeps its model)",
}


class Slider(NamedTuple):
    """A slider of the page: a number of the case, by its dotted path, with its unit and meaning.

    `parameter`: its index among the parameters P of the JavaScript. `value`: the case's value. `low`, `high`: ends of
    the slider. `least`, `most`: smallest and largest allowed value; `open`: whether `least` itself is excluded.
    `grid`: whether the number is a time at which a disturbance jumps. The page rounds such a time to a whole sample.
    """

    path: str
    unit: str
    doc: str
    parameter: int
    value: float
    low: float
    high: float
    log: bool
    least: float
    most: float
    open: bool
    whole: bool
    grid: bool


def sliders(case: Case, others: list[Case]) -> list[Slider]:
    """Return the sliders of a case, in the order of GROUPS. Their ranges contain the values of the `others` too."""
    known = {path: place for path, place in _places(case).items() if _offered(path, place)}
    index = parameters(case, list(known))
    tables = [_places(other) for other in others]
    edges = {float(x) for x in case.scenario.edges()}
    found = []
    for path, place in known.items():
        values = [float(place.value), *(float(t[path].value) for t in tables if _number(t.get(path)))]
        shown = _range(path, place, values, case)
        meta = place.field.metadata
        least = next((x for x in (meta["above"], meta["at_least"]) if x is not None), -math.inf)
        most = math.inf if meta["at_most"] is None else meta["at_most"]
        most = shown[1] if path == "processor.delay" else most  # the program admits no longer delay
        grid = values[0] in edges and path.rpartition(".")[2] in ("start", "stop")
        words = meta["unit"] or UNITS.get(str(place.route[1]), ""), meta["doc"]
        limits = least, most, meta["above"] is not None
        whole = path == SEED or bool(meta["whole"])
        found.append(Slider(path, *words, index[path], values[0], *shown, *limits, whole, grid))
    order = list(GROUPS)
    return sorted(found, key=lambda one: next(k for k, prefix in enumerate(order) if one.path.startswith(prefix)))


def _places(case: Case) -> dict[str, Place]:
    (field,) = (field for field in dataclasses.fields(case.scenario) if field.name == "seed")
    return {**places(case.cascade, case.scenario), SEED: Place((1, "seed"), field, case.scenario.seed)}


def parameters(case: Case, paths: list[str]) -> dict[str, int]:
    """Return, by path, the index of the parameter that a number sets. Each number changes exactly one parameter."""
    own, found = parameter_values(case), {}
    for path in paths:
        (found[path],) = np.flatnonzero(parameter_values(changed(case, {path: np.array(math.pi)})) != own)
    return {path: int(k) for path, k in found.items()}


def changed(case: Case, values: Mapping[str, float | np.ndarray]) -> Case:
    """Return the case with the numbers at these paths replaced. `values`: new values by path."""
    values, seed = dict(values), values.get(SEED, case.scenario.seed)
    values.pop(SEED, None)
    cascade, scenario = with_values(case.cascade, case.scenario, values)
    return dataclasses.replace(case, cascade=cascade, scenario=dataclasses.replace(scenario, seed=seed))


def parameter_values(case: Case) -> np.ndarray:
    """Return the case's values of the parameters P of the JavaScript [parameters]."""
    return np.array([float(x) for x in jax.tree.leaves(loop_parameters(case))])


def _number(place: Place | None) -> bool:
    return place is not None and place.value is not None and bool(np.isfinite(place.value))


def _offered(path: str, place: Place) -> bool:
    """Return whether a number has a slider: a finite number of a group, except the controller's model and SHIFT."""
    model = path.startswith("controller.model.")
    return path.startswith(tuple(GROUPS)) and not model and place.route[-1] != SHIFT and _number(place)


def _range(path: str, place: Place, values: list[float], case: Case) -> tuple[float, float, bool]:
    """Return the ends of a slider that contain these values, and whether it is logarithmic."""
    meta, name = place.field.metadata, path.rpartition(".")[2]
    small, large = min(values), max(values)
    wide = path.startswith(("controller.", "actuator.")) or name == "bandwidth" or name.startswith("range_")
    if wide and small > 0:
        low, high, log = small / FACTOR, large * FACTOR, True
    elif path.startswith("plant.") or path == "sensor.gain":
        ends = [x * (1 + side * SHARE) for x in values for side in (-1, 1)]
        low, high, log = (min(ends), max(ends), False) if any(values) else (-10.0, 10.0, False)
    elif meta["unit"] == "s" and name in ("start", "stop"):
        low, high, log = min(0.0, small), max(float(case.clock.duration), large), False
    elif path == "processor.delay":
        low, high, log = 0.0, longest_delay(case), False
    elif path.startswith("processor."):
        low, high, log = 0.0, float(meta["at_most"]), False
    elif path == SEED:
        low, high, log = 0.0, max(100.0, large), False
    elif path == "run.clearance":
        low, high, log = 0.2 * small, max(large, 0.95 * float(case.scenario.plant.s_0)), False
    elif path == "initial.z":
        most = max(-small, large, 0.95 * float(case.scenario.limit))
        low, high, log = -most, most, False
    elif meta["whole"]:
        low, high, log = float(meta["at_least"]), float(meta["at_most"]), False
    else:
        size = max(abs(small), abs(large)) or _size(meta["unit"] or UNITS.get(str(place.route[1]), ""), case)
        low, high, log = (0.0 if meta["at_least"] == 0 or small > 0 else -TIMES * size), TIMES * size, False
    least = meta["at_least"] if meta["at_least"] is not None else meta["above"]
    if least is not None:
        low = max(low, least)
    if meta["at_most"] is not None:
        high = min(high, meta["at_most"])
    return low, high, log


def _size(unit: str, case: Case) -> float:
    """Return a typical size of a quantity that is 0 in the case, from its unit."""
    plant = case.scenario.plant
    z, z_dot, i = (float(x) for x in plant.sizes())
    sizes = {"m": z, "m/s": z_dot, "A": i, "m/s^2": 1.0, "A/s": i * float(plant.pole), "Hz": 10.0}
    return sizes.get(unit, 1.0)
