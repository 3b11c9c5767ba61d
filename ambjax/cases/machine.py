"""Reader of the case file of a whole machine: [rotor], [[bearing]], [[unbalance]], [[load]], and the common tables."""

import copy
import dataclasses
import math
import pathlib
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.cases.reader import TABLES, Case, case_from, require_file, safe_name
from ambjax.cases.recordings import Recordings
from ambjax.cases.scenario_tables import signal_from
from ambjax.cases.table import Table, load, show
from ambjax.linear.analysis import Zones
from ambjax.numerics.records import canonical, leaf
from ambjax.simulation.clock import Clock
from ambjax.simulation.explicit import DOP853, RK4, Euler
from ambjax.simulation.machine import Machine, machine_of
from ambjax.simulation.method import ACCURATE, slopes
from ambjax.simulation.rollout import prepare
from ambjax.text.words import one_line
from ambjax.world.rotation import PER_MINUTE
from ambjax.world.rotor import Rotor, RotorLoad, RotorUnbalance

KINDS = ["rigid", "modal"]
RIGID = 5
COORDINATES = ("x", "y", "z", "beta_x", "beta_y")
# Tables that describe one axis, which each bearing may change.
OWN = ("plant", "controller", "sensor", "actuator", "reference")
MACHINE_TABLES = ("rotor", "bearing", "unbalance", "load")
# Product of step and angular frequency of a mode (or of nutation) at which the relative error of RK4 in one period is
# below 1e-6.
MODE = 0.1
# Largest number of speeds of the sensitivity.
MOST_SPEEDS = 100
# Largest number of substeps that the reader chooses.
MOST_SUBSTEPS = 512
LENGTH = leaf(default=0.0, unit="m", at_least=-100.0, at_most=100.0, doc="place on the shaft, from the centre of mass")
ANGLE = leaf(default=0.0, unit="degrees", at_least=-360.0, at_most=360.0, doc="angle of the first axis from x")
AMOUNT, PHASE = (field for field in dataclasses.fields(RotorUnbalance) if field.name in ("amount", "phase"))
NUMBERS = {
    "m": leaf(unit="kg", at_least=1e-6, at_most=1e6, doc="mass"),
    "I_t": leaf(unit="kg m^2", at_least=1e-12, at_most=1e9, doc="moment of inertia about an axis across the shaft"),
    "I_p": leaf(unit="kg m^2", at_least=0.0, at_most=1e9, doc="moment of inertia about the shaft"),
}
SPEED, ACCELERATION = (field for field in dataclasses.fields(Rotor) if field.name in ("speed", "acceleration"))
FREQUENCY = leaf(unit="Hz", at_least=1e-3, at_most=1e6, doc="frequency of a bending mode, free and at rest")
DAMPING = leaf(default=0.0, unit="1", at_least=0.0, at_most=1.0, doc="damping ratio of a bending mode")


class Axis(NamedTuple):
    """One axis of a bearing: its name, the bearing's number, its magnet's row b and its sensor's row c, each [n]."""

    name: str
    bearing: int
    b: np.ndarray
    c: np.ndarray


@dataclasses.dataclass(frozen=True)
class MachineCase:
    """The case of a whole machine.

    `machine`: rotor and axes, for a rollout with `clock`. `axes`: names of the axes. `coordinates`: names of the
    rotor's coordinates. `cases`: the case of each axis, with the mass and the weight that it carries. `settle`: time
    from which "settled" metrics count, s. `zones`, `speeds`: range, limits and speeds (rpm) of the sensitivity. `text`:
    the file as read.
    """

    name: str
    machine: Machine
    clock: Clock
    axes: tuple[str, ...]
    coordinates: tuple[str, ...]
    cases: tuple[Case, ...]
    settle: float
    zones: Zones
    speeds: tuple[float, ...]
    text: str = ""


def read_machine(path: str | pathlib.Path) -> MachineCase:
    """Read and check the case file of a machine. Raises ValueError, one line, for an invalid file."""
    case = read_any(path)
    if isinstance(case, Case):
        raise ValueError(one_line(f"{path}: it has no [rotor] with a kind: it is the case of one axis. Use read_case."))
    return case


def read_any(path: str | pathlib.Path) -> Case | MachineCase:
    """Read and check a case file: of one axis, or of a whole machine. Raises ValueError, one line, as `read_case`."""
    require_file("path", path)
    path = pathlib.Path(path)
    raw, text = load(path)
    try:
        return (machine_from if is_machine(raw) else case_from)(raw, path.stem, text, path.parent)
    except ValueError as error:
        raise ValueError(one_line(f"{path}: {error}")) from None


def is_machine(raw: dict[str, Any]) -> bool:
    """Return whether a parsed case file describes a whole machine."""
    return "bearing" in raw or (isinstance(raw.get("rotor"), dict) and "kind" in raw["rotor"])


def machine_from(
    raw: dict[str, Any], name: str = "case", text: str = "", folder: pathlib.Path = pathlib.Path()
) -> MachineCase:
    """Return the machine of a parsed TOML document. Raises ValueError, one line, for an invalid one."""
    top = Table(raw)
    top.only([*TABLES, *MACHINE_TABLES, "tune"])
    for table, instead in (("disturbance", "[[load]]"), ("spread", "one case for each value")):
        if table in raw:
            raise ValueError(f"[{table}]: a machine with [rotor] does not take it yet. Use {instead} instead.")
    rotor_table = top.table("rotor")
    frequencies, dampings = _modes(rotor_table)
    bearings = _list(top, "bearing")
    if not bearings:
        raise ValueError("[[bearing]] is missing: give one for each bearing, with kind and at.")
    axes = _axes(bearings, len(frequencies))
    rotor = _rotor(top, rotor_table, axes, frequencies, dampings, folder)
    q = _start(top.table("initial"), rotor)
    _check_rank(rotor, axes)
    masses, forces = _shares(rotor, axes)
    cases = []
    for axis, m, force in zip(axes, masses, forces, strict=True):
        own = _axis_raw(raw, bearings[axis.bearing], axis, m, force, float(axis.b @ q))
        try:
            case = case_from(own, axis.name, "", folder)
        except ValueError as error:
            raise ValueError(f"axis {axis.name}: {error}") from None
        _check_force(case, axis, force)
        cases.append(case)
    clock = _clock(cases, rotor, fixed=not isinstance(raw.get("clock", {}).get("dt", "auto"), str))
    systems = [canonical(prepare(case.cascade, case.scenario, clock)[0]) for case in cases]
    first = jax.tree.structure(systems[0])
    for axis, system in zip(axes, systems, strict=True):
        if jax.tree.structure(system) != first:
            raise ValueError(
                f"bearing: the axes {axes[0].name} and {axis.name} have different kinds of parts, or keys that only "
                "one of them gives. All axes need the same kinds and the same optional keys; their numbers may differ."
            )
    stacked = jax.tree.map(lambda *x: np.stack(x), *systems)
    names = (*COORDINATES, *(f"mode{k + 1}_{d}" for k in range(len(frequencies)) for d in "xy"))
    return MachineCase(
        safe_name(name), machine_of(rotor, stacked, q), clock, tuple(axis.name for axis in axes), names, tuple(cases),
        cases[0].settle, cases[0].zones, _speeds(top.table("sensitivity"), rotor, float(clock.duration)), text,
    )  # fmt: skip


def _speeds(table: Table, rotor: Rotor, duration: float) -> tuple[float, ...]:
    """Return sensitivity.speeds, rpm; by default those at the start and, after a run-up, at the end."""
    value = table.raw.get("speeds")
    if value is None:
        first, last = float(rotor.speed), float(rotor.speed + rotor.acceleration * duration)
        return (first,) if first == last else (first, last)
    if not isinstance(value, list) or not 0 < len(value) <= MOST_SPEEDS:
        raise ValueError(f"{table.at('speeds')} = {show(value)}: it must be a list of 1 to {MOST_SPEEDS} speeds, rpm.")
    return tuple(Table({f"speeds[{k}]": x}, table.path).leaf(f"speeds[{k}]", SPEED) for k, x in enumerate(value))


def _list(top: Table, name: str) -> list[Table]:
    """Return the tables of a list, written as [[name]]."""
    raw = top.raw.get(name, [])
    if not isinstance(raw, list):
        raise ValueError(f"{name} = {show(raw)}: write [[{name}]] above each.")
    return [Table(one, f"{name}[{k}]") for k, one in enumerate(raw)]


def _modes(table: Table) -> tuple[list[float], list[float]]:
    """Return the frequencies (Hz) and damping ratios of the bending modes."""
    kind = table.choice("kind", KINDS)
    names = [*NUMBERS, "kind", "gravity", "speed", "acceleration", *(["modes"] if kind == "modal" else [])]
    table.only(names)
    tables = _list(Table(table.raw, table.path), "modes")
    for one in tables:
        one.only(["frequency", "damping"])
    return (
        [_needed(one, "frequency", FREQUENCY) for one in tables],
        [one.leaf("damping", DAMPING, 0.0) for one in tables],
    )


def _needed(table: Table, key: str, field: Any) -> float:
    if key not in table.raw:
        raise ValueError(f"{table.at(key)} is missing: give the {field.metadata['doc']}, {field.metadata['unit']}.")
    return table.leaf(key, field)


def _vector(table: Table, key: str, length: int, default: Any = None) -> np.ndarray:
    """Return a list of `length` numbers; `default` if it is left out."""
    if key not in table.raw and default is not None:
        return np.asarray(default, float)
    value = table.array(key, None, f"a list of {length} numbers")
    if value is None or np.shape(value) != (length,) or not np.all(np.isfinite(np.asarray(value, float))):
        given = "is missing" if key not in table.raw else f"= {show(table.raw[key])}"
        raise ValueError(f"{table.at(key)} {given}: it must be a list of {length} numbers.")
    return np.asarray(value, float)


def _row(at: float, direction: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Return the displacement [n] along `direction` of the shaft at `at` (m) per unit of each coordinate."""
    x, y, z = direction
    return np.concatenate([[x, y, z, -at * y, at * x], np.outer(shapes, [x, y]).ravel()])


def _axes(bearings: list[Table], modes: int) -> list[Axis]:
    """Return the axes of all bearings: two of a radial one, at `angle` and 90 degrees further; one of an axial one."""
    axes, seen = [], set()
    keys = ["name", "kind", "at", "sensor_at", "angle", "modes", "sensor_modes", *OWN]
    for number, table in enumerate(bearings):
        table.only(keys)
        kind = table.choice("kind", ["radial", "axial"])
        name = table.raw.get("name", f"bearing{number + 1}")
        if not isinstance(name, str) or not name or name in seen:
            raise ValueError(f"{table.at('name')} = {show(name)}: each bearing needs a name of its own, as text.")
        seen.add(name)
        at = _needed(table, "at", LENGTH) if kind == "radial" else table.leaf("at", LENGTH, 0.0)
        sensor_at = table.leaf("sensor_at", LENGTH, at)
        none = np.zeros(modes) if kind == "axial" or modes == 0 else None
        shapes = _vector(table, "modes", modes, none)
        sensed = _vector(table, "sensor_modes", modes, shapes if sensor_at == at or none is not None else None)
        angle = math.radians(table.leaf("angle", ANGLE, 0.0))
        if kind == "axial":
            directions = {"z": np.array([0.0, 0.0, 1.0])}
        else:
            cos, sin = _exact(math.cos(angle)), _exact(math.sin(angle))
            directions = {"x": np.array([cos, sin, 0.0]), "y": np.array([-sin, cos, 0.0])}
        axes += [
            Axis(f"{name}.{label}", number, _row(at, d, shapes), _row(sensor_at, d, sensed))
            for label, d in directions.items()
        ]
    return axes


def _exact(x: float) -> float:
    """Return x, or the whole number within rounding of it, so that axes along x and y are uncoupled."""
    return float(round(x)) if abs(x - round(x)) < 1e-15 else x


def _rotor(
    top: Table, table: Table, axes: list[Axis], frequencies: list[float], dampings: list[float], folder: pathlib.Path
) -> Rotor:
    """Return the rotor of the tables [rotor], [[unbalance]] and [[load]]."""
    m, I_t, I_p = (_needed(table, name, field) for name, field in NUMBERS.items())
    if I_p > 2 * I_t:
        raise ValueError(f"{table.at('I_p')} = {I_p:g}: it must be at most 2 I_t = {2 * I_t:g} kg m^2, as of a disc.")
    n = RIGID + 2 * len(frequencies)
    w = 2 * np.pi * np.repeat(frequencies, 2)
    M, D, G, K = np.eye(n), np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    M[range(RIGID), range(RIGID)] = m, m, m, I_t, I_t
    G[3, 4], G[4, 3] = I_p, -I_p
    K[range(RIGID, n), range(RIGID, n)] = w**2
    D[range(RIGID, n), range(RIGID, n)] = 2 * np.repeat(dampings, 2) * w
    gravity = np.zeros(n)
    gravity[:3] = m * _vector(table, "gravity", 3, (0.0, -9.81, 0.0))
    count = len(frequencies)
    return Rotor(
        M, D, G, K, np.stack([axis.b for axis in axes]), np.stack([axis.c for axis in axes]), gravity,
        table.leaf("speed", SPEED, 0.0), table.leaf("acceleration", ACCELERATION, 0.0),
        tuple(_unbalance(one, count) for one in _list(top, "unbalance")),
        tuple(_load(one, count, Recordings(folder, ())) for one in _list(top, "load")),
    )  # fmt: skip


def _unbalance(table: Table, modes: int) -> RotorUnbalance:
    table.only(["at", "amount", "phase", "modes"])
    shapes = _vector(table, "modes", modes, np.zeros(modes))
    at = table.leaf("at", LENGTH, 0.0)
    along = (_row(at, np.array(d), shapes) for d in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    return RotorUnbalance(_needed(table, "amount", AMOUNT), *along, table.leaf("phase", PHASE, 0.0))


def _load(table: Table, modes: int, recordings: Recordings) -> RotorLoad:
    places = ("at", "direction", "modes")
    direction = _vector(table, "direction", 3)
    size = float(np.linalg.norm(direction))
    if size == 0:
        raise ValueError(f"{table.at('direction')} = {show(table.raw['direction'])}: it must not be zero.")
    along = _row(table.leaf("at", LENGTH, 0.0), direction / size, _vector(table, "modes", modes, np.zeros(modes)))
    rest = Table({key: value for key, value in table.raw.items() if key not in places}, table.path)
    return RotorLoad(signal_from(rest, "N", recordings), along)


def _start(table: Table, rotor: Rotor) -> np.ndarray:
    """Return the coordinates at t = 0 [n]; the bending modes are at rest."""
    table.only(["q", "i"])
    q = np.zeros(len(rotor.gravity))
    q[:RIGID] = _vector(table, "q", RIGID, np.zeros(RIGID))
    return q


def _check_rank(rotor: Rotor, axes: list[Axis]) -> None:
    """Raise ValueError if magnets or sensors leave a coordinate free that any of them acts on, or a weight."""
    for rows, what in ((rotor.at_magnets, "magnets"), (rotor.at_sensors, "sensors")):
        rigid = np.asarray(rows)[:, :RIGID]
        used = [k for k in range(RIGID) if np.any(rigid[:, k])]
        free = [COORDINATES[k] for k in range(RIGID) if k not in used and (k != 2 or rotor.gravity[2] != 0)]
        if free:
            raise ValueError(f"bearing: no axis holds {', '.join(free)}. Add a bearing whose {what} act on it.")
        scale = np.abs(rigid[:, used]).max(0)
        rank = int(np.linalg.matrix_rank(rigid[:, used] / scale, tol=1e-9))
        if rank < len(used):
            raise ValueError(
                f"bearing: the {what} of the {len(axes)} axes determine {rank} of the {len(used)} rigid motions "
                f"({', '.join(COORDINATES[k] for k in used)}). Place radial bearings at two different places."
            )


def _shares(rotor: Rotor, axes: list[Axis]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mass (kg) and the weight (N) that each axis carries [c]: 1/(b M^-1 b), and least-norm forces."""
    B, M = np.asarray(rotor.at_magnets)[:, :RIGID], np.asarray(rotor.M)[:RIGID, :RIGID]
    masses = 1 / np.sum(B * np.linalg.solve(M, B.T).T, 1)
    return masses, np.linalg.pinv(B.T) @ -np.asarray(rotor.gravity)[:RIGID]


def _check_force(case: Case, axis: Axis, force: float) -> None:
    most = float(case.scenario.largest_force)
    if abs(force) > most:
        raise ValueError(
            f"axis {axis.name}: it must carry {abs(force):.4g} N, and its magnet gives at most {most:.4g} N at the "
            "centre. Increase plant.n, plant.A or plant.i_0, or reduce plant.s_0."
        )


def _axis_raw(raw: dict[str, Any], bearing: Table, axis: Axis, m: float, force: float, z: float) -> dict[str, Any]:
    """Return the case of one axis: the common tables, what the bearing changes, and the rotor's share."""
    own = copy.deepcopy({key: value for key, value in raw.items() if key not in (*MACHINE_TABLES, "initial", "tune")})
    for table in OWN:
        if table in bearing.raw:
            own[table] = _merged(own.get(table, {}), bearing.table(table).raw)
    plant = own.setdefault("plant", {})
    for name in ("m", "k_z", "g"):
        if isinstance(plant, dict) and name in plant:
            raise ValueError(f"plant.{name} = {show(plant[name])}: the rotor gives it. Leave it out beside [rotor].")
    own["plant"] = plant | {"m": m, "k_z": 0.0, "g": force / m}
    if isinstance(own.get("sensitivity"), dict):
        own["sensitivity"].pop("speeds", None)
    own["initial"] = {key: value for key, value in raw.get("initial", {}).items() if key != "q"} | {"z": z}
    return own


def _merged(common: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return the common table with the keys of another one, recursively."""
    both = dict(common)
    for key, value in own.items():
        both[key] = _merged(both[key], value) if isinstance(value, dict) and isinstance(both.get(key), dict) else value
    return both


def _clock(cases: list[Case], rotor: Rotor, fixed: bool) -> Clock:
    """Return the clock with a method whose fixed steps resolve every axis, the bending modes and nutation.

    `fixed`: whether the case gives the step.
    """
    clock, period = cases[0].clock, float(cases[0].clock.sample_period)
    methods = [case.clock.method for case in cases]
    if all(isinstance(method, (RK4, DOP853, Euler)) for method in methods):
        most: Any = max(methods, key=lambda method: method.substeps)
    else:
        slope = max(max(slopes(case.cascade, case.scenario).values()) for case in cases)
        most = RK4(max(math.ceil(period * slope / ACCURATE), 1))
    W = 2 * np.pi * PER_MINUTE * max(abs(rotor.speed), abs(rotor.speed + rotor.acceleration * float(clock.duration)))
    M, K, G = (np.asarray(x) for x in (rotor.M, rotor.K, rotor.G))
    fastest = max(math.sqrt(float(np.max(np.diag(K) / np.diag(M)))), float(W * np.max(np.abs(G) / np.diag(M)[:, None])))
    substeps = most.substeps if fixed else max(most.substeps, math.ceil(period * fastest / MODE))
    if substeps > MOST_SUBSTEPS:
        raise ValueError(
            f"clock: this machine needs {substeps} steps in a sample of {period:g} s; at most {MOST_SUBSTEPS} are "
            "allowed. Use a processor or smooth gains, leave out the fastest modes, or shorten clock.sample_period."
        )
    return dataclasses.replace(clock, method=dataclasses.replace(most, substeps=substeps))
