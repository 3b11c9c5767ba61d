"""Controllers of a whole machine: readers of keys of [controller] that one axis does not have, and a trial."""

import copy
import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.cases.controller_tables import KINDS
from ambjax.cases.machine_linear import linear, lqg, numbers
from ambjax.cases.own_laws import FORM, OwnLaw, is_own, tried
from ambjax.cases.reader import Case
from ambjax.cases.rotor_tables import COORDINATES, RIGID
from ambjax.cases.table import Table
from ambjax.control.current import OpenLoop
from ambjax.control.law_trial import same_shapes
from ambjax.control.machine_law import MachineLaw
from ambjax.control.observer import Direct
from ambjax.control.position import FeedbackLinearisation
from ambjax.control.rigid_body import RigidBody
from ambjax.numerics.records import canonical
from ambjax.simulation.machine_kinds import SampledMachine
from ambjax.simulation.rollout import prepare
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.whole_machine import Machine
from ambjax.world.rotor import Rotor

# Keys of [controller] for a machine. The tables replace keys of the common ones for the tilts and for the axial motion.
TABLES = {"tilt": ("beta_x", "beta_y"), "axial": ("z",)}
KEYS = ("kind", "coordinates", "compensate_gyroscopics", *TABLES, "file", "output", "lqg")
INNER = ("model", "inversion", "current")  # tables beside a custom law
WAYS, LAWS = ["axes", "rigid-body"], ["cascade", "linear", "lqg"]


def merged(
    common: dict[str, Any], own: dict[str, Any], joins: Callable[[Any], bool] = lambda x: isinstance(x, dict)
) -> dict[str, Any]:
    """Return the common table with the keys of another one, recursively. Another `kind` replaces the whole table.

    `joins`: whether a value is joined with that of the common table, and does not replace it.
    """
    if "kind" in own and own["kind"] != common.get("kind", own["kind"]):
        return own
    both = dict(common)
    for key, value in own.items():
        joined = joins(value) and isinstance(both.get(key), dict)
        both[key] = merged(both[key], value, joins) if joined else value
    return both


def kind_of(raw: dict[str, Any]) -> str:
    """Return controller.kind of a machine."""
    table = Table(raw).table("controller")
    kind = table.raw.get("kind")
    if kind in list(KINDS["position"]) and kind not in LAWS:
        raise ValueError(f'{table.at("kind")} = "{kind}": it is a law of each axis. Set controller.position.kind.')
    return str(kind) if is_own(kind) else table.choice("kind", LAWS, LAWS[0], FORM)


def axis_controller(raw: dict[str, Any]) -> None:
    """Change the [controller] and [processor] of a case of a machine to those of one axis."""
    controller = raw.get("controller")
    if not isinstance(controller, dict):
        return
    kind = kind_of(raw)
    for key in (*KEYS, "notch"):
        controller.pop(key, None)
    if kind == LAWS[0]:
        return
    # `inner` replaces observer and position law, which need no velocity here
    outer = {"observer": {"kind": "kalman"}, "position": {"kind": "state-feedback"}}
    inner = {"inversion": {"kind": "linearised"}}
    if "current" not in controller and raw.get("actuator", {}).get("mode", "voltage") == "voltage":
        inner["current"] = {"kind": "pi"}
    if is_own(kind):
        raw["controller"] = inner | {key: controller[key] for key in INNER if key in controller} | outer
    else:
        raw["controller"] = controller | outer | inner
    if isinstance(raw.get("processor"), dict):
        if Table(raw).table("processor").switch("predict"):
            law = f'controller.kind = "{kind}"'
            raise ValueError(f"processor.predict = true: {law} predicts nothing. Leave predict out.")
        raw["processor"]["predict"] = False


def law_from(
    top: Table,
    rotor: Rotor,
    bearings: list[Table],
    cases: list[Case],
    read: Callable[[dict, str], Case],
    folder: pathlib.Path,
    own_law: OwnLaw | None,
) -> tuple[MachineLaw | None, list[Case]]:
    """Return the law of all axes, None if each axis has its own, and the cases of its parts.

    `cases`: of the axes. `read`: reads a raw case with a name. `own_law`: the custom law of the machine, if it has one.
    """
    table = top.table("controller")
    if own_law is not None:
        for bearing in bearings:
            bearing.table("controller").only([*INNER, "notch"])
        given = table.record(own_law.law, extra=("kind", *INNER, "notch"))
        return tried(own_law, lambda: given.designed(rotor)), []
    if (kind := kind_of(top.raw)) != LAWS[0]:
        for bearing in bearings:
            bearing.table("controller").only(["model", "notch", *(["current"] if kind == "linear" else [])])
        return (linear(top, cases, folder) if kind == "linear" else lqg(top, cases, rotor)), []
    for key in ("file", "output", "lqg"):
        if key in table.raw:
            raise ValueError(f'{table.at(key)} is for kind = "{"lqg" if key == "lqg" else "linear"}". Set it.')
    way = table.choice("coordinates", WAYS, WAYS[0])
    compensated = table.switch("compensate_gyroscopics")
    if way == WAYS[0]:
        for key in ("compensate_gyroscopics", *TABLES):
            if key in table.raw:
                raise ValueError(f'{table.at(key)} is for coordinates = "rigid-body". Set it, or leave {key} out.')
        return None, []
    for bearing in bearings:
        own = bearing.table("controller")
        for key in ("observer", "position"):
            if key in own.raw:
                advice = f"Use [controller.tilt.{key}] or [controller.axial.{key}]."
                raise ValueError(f"{own.at(key)}: in rigid-body coordinates no bearing has its own {key}. {advice}")
    return rigid_body(top, rotor, cases, read, bool(compensated))


def rigid_body(
    top: Table, rotor: Rotor, cases: list[Case], read: Callable[[dict, str], Case], compensated: bool
) -> tuple[RigidBody, list[Case]]:
    """Return the law in rigid-body coordinates, and the cases of the coordinates."""
    B, C, M, G = (np.asarray(x, float) for x in (rotor.at_magnets, rotor.at_sensors, rotor.M, rotor.G))
    held = [k for k in range(RIGID) if np.any(B[:, k])]
    B, C, M = B[:, held], C[:, held], np.diag(M)[held]
    model = cases[0].cascade.model
    kappa, s_0, i_0, m, g = (numbers(cases, name) for name in ("kappa", "s_0", "i_0", "m", "g"))
    weight = np.asarray(rotor.gravity, float)[held] / M
    parts = []
    for number, k in enumerate(held):
        plant = nominal(model, B[:, number], kappa, s_0, i_0)
        same = {name: float(getattr(model, name)) for name in ("mu_0", "n", "R")}
        given = same | plant | {"m": float(M[number]), "k_z": 0.0, "g": float(-weight[number])}
        parts.append(_coordinate(top, COORDINATES[k], given, read))
    systems = [prepare(part.cascade, part.scenario, part.clock)[0] for part in parts]
    laws = [canonical((one.loop if isinstance(one, Sampled) else one).cascade) for one in systems]
    if len({jax.tree.structure(law) for law in laws}) > 1:
        raise ValueError("controller.tilt, controller.axial: the laws must be of the same kind in all coordinates.")
    law = RigidBody(
        laws=jax.tree.map(lambda *x: np.stack(x), *laws),
        from_sensors=jnp.asarray(np.linalg.pinv(C)),
        at_sensors=jnp.asarray(C),
        at_magnets=jnp.asarray(B),
        accelerations=jnp.asarray(B.T * m / M[:, None]),
        weights=jnp.asarray(g),
        forces=jnp.asarray(np.linalg.pinv(B.T) * M / (kappa / 4)[:, None]),
        gyroscopic=jnp.asarray(G[np.ix_(held, held)] / M[:, None]) if compensated else None,
    )
    return law, parts


def nominal(model: Any, b: np.ndarray, kappa: np.ndarray, s_0: np.ndarray, i_0: np.ndarray) -> dict[str, float]:
    """Return A, s_0 and i_0 of the magnet with stiffness, force per current and largest force of all on a coordinate.

    `b`: displacements at the magnets [c] per unit of the coordinate. The others: numbers of the magnets [c].
    """
    stiffness, lever = kappa * i_0**2 / s_0**3, np.abs(b)
    force, per_current = lever @ (stiffness * s_0), lever @ (stiffness * s_0 / i_0)
    gap, bias = force / (b**2 @ stiffness), force / per_current
    area = force * gap**2 / bias**2 / (model.mu_0 * model.n**2)
    return {"A": float(area), "s_0": float(gap), "i_0": float(bias)}


def _coordinate(top: Table, name: str, plant: dict[str, float], read: Callable[[dict, str], Case]) -> Case:
    controller = copy.deepcopy(top.raw.get("controller", {}))
    for table, names in TABLES.items():
        own = top.table("controller").table(table)
        own.only(["observer", "position"])
        if name in names:
            controller = merged(controller, own.raw)
    for key in ("model", "notch"):
        controller.pop(key, None)
    raw = {"plant": plant, "controller": controller}
    raw |= {key: copy.deepcopy(top.raw[key]) for key in ("processor", "clock") if key in top.raw}
    for key, names in (("sensor", ("velocity",)), ("actuator", ("mode", "bandwidth"))):
        raw[key] = {name: top.raw[key][name] for name in names if name in top.raw.get(key, {})}
    axis_controller(raw)
    return read(raw, f"coordinate {name}")


def inner(system: Any, law: MachineLaw) -> Any:
    """Return the loop of an axis whose observer and position law never act, because of a law of the machine."""
    loop = system.loop if isinstance(system, Sampled) else system
    cascade = loop.cascade
    position = FeedbackLinearisation().designed(cascade.model, None)
    cascade = dataclasses.replace(cascade, observer=Direct(), position=position)
    if law.output == "voltage":
        cascade = dataclasses.replace(cascade, current=OpenLoop())
    loop = dataclasses.replace(loop, cascade=cascade)
    return dataclasses.replace(system, loop=loop) if isinstance(system, Sampled) else loop


def try_machine(machine: Machine) -> None:
    """Trace the law of a whole machine in its loop: `begin`, `scale`, and `step` or the call. Raises as `try_law`."""

    def everything(machine: Machine) -> tuple[Any, Any, Any]:
        assert machine.law is not None
        errors = machine.sensor_errors(0)
        state = machine.start()
        if isinstance(machine, SampledMachine):
            return state.law, machine.law.scale(), machine.jump(0.0, state, errors).law
        return state.law, machine.law.scale(), machine.demands(0.0, state, errors)

    begun, scale, _ = jax.eval_shape(everything, canonical(machine))
    same_shapes(scale, begun, "scale() must be like the state that begin returns; it is")
