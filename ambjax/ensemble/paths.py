"""Dotted paths of the case file, and the numbers of a cascade and a scenario to which they refer."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.control.schedule import Schedule
from ambjax.host.extensions import digest_of
from ambjax.numerics.records import bounded, is_traced, replaced
from ambjax.numerics.shapes import axes_of, with_entry
from ambjax.world.scenario import Scenario
from ambjax.world.waveforms import Constant

SHIFT = "shift"
TIME = bounded(0.0, "s", -1e9, 1e9, "time by which start and stop are shifted together")


class Place(NamedTuple):
    """One number of a case.

    - `route`: indices and attribute names that lead to it from the tuple (cascade, scenario).
    - `field`: the dataclass field that declares it.
    - `value`: its value.
    """

    route: tuple[int | str, ...]
    field: dataclasses.Field
    value: Any


def places(cascade: Cascade, scenario: Scenario) -> dict[str, Place]:
    """Return every number of the cascade and the scenario but the seed and the member, by dotted path.

    The paths plant.* refer to the true plant, and controller.model.* to the nominal one. A disturbance of z is
    disturbance.q_z.* if all disturbances of z have the same unit. Otherwise those in m/s^2 are disturbance.q_z.*,
    scaled forces are disturbance.q_v.*, and forces are disturbance.q_f.*. The path *.shift moves start and stop of a
    signal together in time; its value is 0. The path of a value of a schedule ends with the number of its knot, from 0,
    and that of an entry of an array with its indices.
    """
    table: dict[str, Place] = {}
    for stage in ("model", "observer", "position", "inversion", "current"):
        table |= numbers_in(getattr(cascade, stage), f"controller.{stage}", (0, stage))
    table |= numbers_in(cascade.processor, "processor", (0, "processor"))
    notch = numbers_in(cascade.notch, "controller.notch", (0, "notch"))
    table |= {path: place for path, place in notch if "rotor" not in place.route}  # that of the scenario replaces it
    names = {name: name for name in ("plant", "reference", "rotor")} | {"disturbance.q_i": "q_i"}
    names |= {"sensor": "sensor", "actuator": "amplifier", "initial": "initial", "disturbance.base": "base"}
    acting = [slot for slot in ("q_z", "q_v", "q_f") if not _absent(getattr(scenario, slot))] or ["q_z"]
    names |= {f"disturbance.{slot if len(acting) > 1 else 'q_z'}": slot for slot in acting}
    for path, name in names.items():
        table |= numbers_in(getattr(scenario, name), path, (1, name))
    if scenario.rotor is not None and scenario.rotor.changes:  # a table of speeds has no rate of its own
        table = {path: x for path, x in table.items() if path == "rotor.speed" or not path.startswith("rotor.")}
    fields = {field.name: field for field in dataclasses.fields(scenario)}
    for path, name in (("actuator.u_max", "u_max"), ("run.clearance", "clearance")):
        table[path] = Place((1, name), fields[name], getattr(scenario, name))
    for path, place in numbers_in(scenario.stop, "run.stop", (1, "stop")):
        table[path.replace("stop.", "stop_")] = place
    return table


def _absent(signal: object) -> bool:
    """Return whether there is no such disturbance: None, or a constant 0."""
    return signal is None or (isinstance(signal, Constant) and not is_traced(signal.value) and not np.any(signal.value))


def numbers_in(node: object, path: str, route: tuple[int | str, ...]) -> Iterator[tuple[str, Place]]:
    """Yield every number in a record and its nested records. `path`, `route`: dotted path and `Place.route` of it."""
    if isinstance(node, tuple):
        for index, item in enumerate(node):
            yield from numbers_in(item, f"{path}.{index}", (*route, index))
    if not dataclasses.is_dataclass(node):
        return
    for field in dataclasses.fields(node):
        value, at = getattr(node, field.name), (f"{path}.{field.name}", (*route, field.name))
        if isinstance(value, Schedule):
            for knot, x in enumerate(value.values):
                yield f"{at[0]}.{knot}", Place((*at[1], "values", knot), field, x)
        elif field.metadata.get("leaf") and (axes := axes_of(field)) and value is not None:
            known = value if is_traced(value) else np.asarray(value)
            for index in np.ndindex(*np.shape(value)[-len(axes) :]):
                entry = known[(..., *index)]
                yield ".".join(map(str, (at[0], *index))), Place((*at[1], *index), field, entry)
        elif field.metadata.get("leaf"):
            yield at[0], Place(at[1], field, value)
        else:
            yield from numbers_in(value, *at)
    if hasattr(node, "shifted"):
        yield f"{path}.{SHIFT}", Place((*route, SHIFT), TIME, 0.0)


def kinds(node: object, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield what is not a number in a record and its nested records: the type and the static fields, by dotted path.

    For a custom law, the digest of its source is yielded too.
    """
    if isinstance(node, tuple):
        for index, item in enumerate(node):
            yield from kinds(item, f"{path}{index}.")
    if not dataclasses.is_dataclass(node):
        return
    yield f"{path}kind", type(node).__name__
    if digest := digest_of(type(node)):
        yield f"{path}source", digest
    for field in dataclasses.fields(node):
        value, at = getattr(node, field.name), f"{path}{field.name}"
        if field.metadata.get("static"):  # recorded signals appear as their digest, other objects as their name or type
            named = isinstance(value, (str, int, float, bool, tuple, type(None)))
            other = getattr(value, "digest", None) or getattr(value, "__qualname__", type(value).__name__)
            yield at, str(value) if named else other
        elif isinstance(value, Schedule) or not field.metadata.get("leaf"):
            yield from kinds(value, f"{at}.")


def order_pairs(cascade: Cascade, scenario: Scenario) -> list[tuple[str, str]]:
    """Return pairs of paths whose first number must be below the second, for example start and stop of a pulse."""
    pairs = []
    known = places(cascade, scenario)
    for path, place in known.items():
        owner = _get((cascade, scenario), place.route[:-1])
        low, high = getattr(owner, "ordered", (None, None))
        if place.route[-1] == low:
            pairs.append((path, f"{path.rpartition('.')[0]}.{high}"))
    return pairs


def with_values(cascade: Cascade, scenario: Scenario, values: Mapping[str, object]) -> tuple[Cascade, Scenario]:
    """Return the cascade and scenario with the numbers at these paths replaced. Shifts are applied last."""
    known, world = places(cascade, scenario), (cascade, scenario)
    for path in sorted(values, key=lambda path: known[path].route[-1] == SHIFT):
        world = with_number(world, known[path].route, values[path])
    return world


def _get(node: Any, route: tuple[int | str, ...]) -> Any:
    for step in route:
        node = node[step] if isinstance(step, int) else getattr(node, step)
    return node


def with_number(node: Any, route: tuple[int | str, ...], value: Any) -> Any:
    """Return the record, tuple or array `node` with the number at the route of a `Place` replaced."""
    if not route:
        return value
    step, *rest = route
    if step == SHIFT:
        return node.shifted(value)
    if isinstance(step, int):
        if isinstance(node, tuple):
            return (*node[:step], with_number(node[step], tuple(rest), value), *node[step + 1 :])
        return with_entry(node, route, value)
    return replaced(node, **{step: with_number(getattr(node, step), tuple(rest), value)})
