"""Reader of the case file of a whole machine: rotor, bearings, unbalances, loads, base, and the common tables."""

import dataclasses
import functools
import math
import pathlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from ambjax.cases.axis_case import MACHINE_TABLES, as_written, axis_tables, check_axis, stop_slope, with_runout_at
from ambjax.cases.controller_tables import notch_from
from ambjax.cases.machine_controller import inner, kind_of, law_from, merged, try_machine
from ambjax.cases.machine_spread import axis_table, machine_spread, refuse_unused, with_notches
from ambjax.cases.own_laws import OwnLaw, is_own, own_law_of, tried
from ambjax.cases.plausibility import unresolved
from ambjax.cases.reader import TABLES, Case, case_from, is_machine, read_by, safe_name
from ambjax.cases.rotor_numbers import fastest_rotor, widest_rotation
from ambjax.cases.rotor_tables import COORDINATES, RIGID, BearingAxis, axes_and_rotor, vector
from ambjax.cases.speed_table import MOST_SPEEDS, listed_speeds
from ambjax.cases.table import Table, show
from ambjax.compiler.barrier import as_outside_jit
from ambjax.control.cascade import Cascade
from ambjax.control.machine_law import MachineLaw
from ambjax.control.synchronous_notch import SynchronousNotch
from ambjax.ensemble.spread import Spread
from ambjax.linear.analysis import Zones
from ambjax.linear.notch_design import following, speeds_of, with_machine_gains
from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.explicit import DOP853, RK4, Euler
from ambjax.simulation.machine_kinds import machine_of
from ambjax.simulation.method import ACCURATE, DRIVEN, STOP, TOUCHED, require_stable, slopes
from ambjax.simulation.rollout import prepare
from ambjax.simulation.whole_machine import Machine
from ambjax.text.words import one_line
from ambjax.world.rotation import Rotation
from ambjax.world.rotor import Rotor
from ambjax.world.scenario import Scenario
from ambjax.world.waveforms import frequencies_of

# Product of step and angular frequency of a mode (or of nutation) at which the relative error of RK4 in one period is
# below 1e-6.
MODE = 0.1
# Largest number of substeps that the reader chooses.
MOST_SUBSTEPS = 512


@dataclasses.dataclass(frozen=True)
class MachineCase:
    """The case of a whole machine.

    `machine`: rotor and axes, for a rollout with `clock`. `axes`: names of the axes. `coordinates`: names of the
    rotor's coordinates. `cases`: the case of each axis, with the mass and the weight that it carries. `settle`: time
    from which "settled" metrics count, s. `zones`, `speeds`: range, limits and speeds (rpm) of the sensitivity.
    `spread`: the numbers that vary between the members of an ensemble. `text`: the file as read.
    `folder`: that of the file. `own_laws`: the custom laws of the file.
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
    spread: Spread = Spread()
    text: str = ""
    folder: pathlib.Path = pathlib.Path()
    own_laws: tuple[OwnLaw, ...] = ()


AnyCase: TypeAlias = Case | MachineCase


def first_axis(case: AnyCase) -> Case:
    """Return a case of one axis, or that of the first axis of a machine: it has the tables that all axes share."""
    return case if isinstance(case, Case) else case.cases[0]


def read_machine(path: str | pathlib.Path | Mapping[str, Any]) -> MachineCase:
    """Read and check the case file of a machine. A dict of tables, as from TOML, works too.

    Speeds whose frequencies the samples do not resolve cause a UserWarning. Raises ValueError, one line, if `path` is
    neither, if the file cannot be read, or if any part of it is invalid.

        machine = ambjax.read_machine("machine.toml")
    """

    def parse(raw: dict[str, Any], *rest: Any) -> MachineCase:
        if not is_machine(raw):
            why = "it has no [rotor] with a kind, so it is a case of one axis"
            raise ValueError(f"{why}; in Python, read_case reads it.")
        return machine_from(raw, *rest)

    with as_outside_jit():
        case = read_by(parse, path)
        texts = unresolved(case.cases) if isinstance(path, Mapping) else warnings_of_machine(case, path)
    for text in texts:
        warnings.warn(text, stacklevel=2)
    return case


def warnings_of_machine(case: MachineCase, path: str | pathlib.Path) -> list[str]:
    """Return the warnings of a machine that was read from `path`, one line each."""
    return [one_line(f"{path}: {text}") for text in unresolved(case.cases)]


def read_any(path: str | pathlib.Path) -> AnyCase:
    """Read and check a case file: of one axis, or of a whole machine. Raises ValueError, one line, as `read_case`."""
    return read_by(lambda raw, *rest: (machine_from if is_machine(raw) else case_from)(raw, *rest), path)


def machine_from(
    raw: dict[str, Any], name: str = "case", text: str = "", folder: pathlib.Path = pathlib.Path()
) -> MachineCase:
    """Return the machine of a parsed TOML document. Raises ValueError, one line, for an invalid one."""
    top = Table(raw)
    if "disturbance" in raw:
        raise ValueError("[disturbance]: a machine with [rotor] does not take it. Use [[load]] or [[base]] instead.")
    top.only([*(name for name in TABLES if name != "disturbance"), *MACHINE_TABLES[1:], "tune"], ("rotor.m",))
    if (method := top.table("clock").raw.get("method", "auto")) not in ("auto", "rk4", "dop853", "euler"):
        words = "'rk4', 'dop853' or 'euler' with a number for clock.dt, or leave it out"
        raise ValueError(f"clock.method = {show(method)}: a machine takes equal explicit steps. Give {words}.")
    bearings = top.tables("bearing")
    if not bearings:
        raise ValueError("[[bearing]] is missing: give one for each bearing, with kind and at.")
    axes, rotor = axes_and_rotor(top, folder)
    q, currents = _start(top.table("initial"), rotor, len(axes))
    _check_rank(rotor, axes)
    masses, forces = _shares(rotor)

    def read(raw: dict[str, Any], name: str, written: Callable[[str], str] = str) -> Case:
        try:
            return case_from(raw, name, "", folder)
        except ValueError as error:
            raise ValueError(f"{name}: {written(str(error))}") from None

    names = [table.raw.get("name", f"bearing{k + 1}") for k, table in enumerate(bearings)]
    cases, of_notches = [], []
    for axis, m, force, i in zip(axes, masses, forces, currents, strict=True):
        bearing = bearings[axis.bearing]
        own = axis_tables(raw, bearing, axis, m, force, (q, i))
        table, turning = axis_table(raw, axis, names[axis.bearing])
        own |= table
        of_notches.append(turning)
        written = functools.partial(as_written, raw=raw, bearing=bearing, axis=axis)
        case = with_runout_at(axis, read(own, f"axis {axis.name}", written))
        check_axis(case, axis, force, q)
        cases.append(case)
    own_law = own_law_of("", kind, folder) if is_own(kind := kind_of(raw)) else None
    law, parts = law_from(top, rotor, bearings, cases, read, folder, own_law)
    spread = machine_spread(top, rotor, q, axes, names, cases)
    if law is not None:
        refuse_unused(spread, law.output)
    fixed = not isinstance(raw.get("clock", {}).get("dt", "auto"), str)
    clock = _clock([*cases, *parts], fastest_rotor(rotor, spread), fixed)
    controllers = [merged(top.table("controller").raw, own.table("controller").raw) for own in bearings]
    widest = widest_rotation(rotor, spread)
    notches = [notch_of_axis(controllers[axis.bearing], case, widest) for axis, case in zip(axes, cases, strict=True)]
    speeds = _speeds(top.table("sensitivity"), rotor, float(clock.duration))
    modes = range((len(rotor.gravity) - RIGID) // 2)
    coordinates = (*COORDINATES, *(f"mode{k + 1}_{d}" for k in modes for d in "xy"))
    found_laws = [(own_law,) if own_law else (), *(one.own_laws for one in cases)]
    case = MachineCase(
        name=safe_name(name),
        machine=machine_of_axes(rotor, parts_of(cases), clock, q, law),
        clock=clock,
        axes=tuple(axis.name for axis in axes),
        coordinates=coordinates,
        cases=notched(cases, notches),
        settle=cases[0].settle,
        zones=cases[0].zones,
        speeds=speeds,
        spread=spread,
        text=text,
        folder=folder,
        own_laws=tuple(dict.fromkeys(law for laws in found_laws for law in laws)),
    )
    case = with_notches_for(case, [*speeds, *speeds_of(widest, float(clock.duration))])
    spread = with_notches(spread, of_notches, axes, case.cases)
    if own_law is not None:
        tried(own_law, lambda: try_machine(case.machine))
    return dataclasses.replace(case, spread=spread)


def parts_of(cases: Sequence[Case]) -> list[tuple[Cascade, Scenario]]:
    """Return the laws and the scenario of each axis."""
    return [(case.cascade, case.scenario) for case in cases]


def machine_of_axes(
    rotor: Rotor, parts: Sequence[tuple[Cascade, Scenario]], clock: Clock, q: Any, law: MachineLaw | None
) -> Machine:
    """Return the machine of a rotor and its axes. `q`: coordinates at t = 0. `law`: of the whole machine."""
    systems = [prepare(*part, clock)[0] for part in parts]
    systems = [canonical(system if law is None else inner(system, law)) for system in systems]
    return machine_of(rotor, systems, jnp.asarray(q), law)


def notched(cases: Sequence[Case], notches: Sequence[SynchronousNotch | None]) -> tuple[Case, ...]:
    """Return the cases of the axes with these notches."""
    laws = [dataclasses.replace(case.cascade, notch=notch) for case, notch in zip(cases, notches, strict=True)]
    return tuple(dataclasses.replace(case, cascade=own) for case, own in zip(cases, laws, strict=True))


def with_notches_for(case: MachineCase, speeds: Sequence[float]) -> MachineCase:
    """Return the case with the gains of its notches for its controllers and these speeds, rpm."""
    notches, machine = [one.cascade.notch for one in case.cases], case.machine
    if not any(notches):
        return case

    def made(cases: Sequence[Case]) -> Machine:
        return machine_of_axes(machine.rotor, parts_of(cases), case.clock, machine.start_q, machine.law)

    bare = made(notched(case.cases, [None] * len(notches)))
    cases = notched(case.cases, with_machine_gains(bare, notches, case.clock, speeds))
    return dataclasses.replace(case, cases=cases, machine=made(cases))


def notch_of_axis(controller: dict[str, Any], case: Case, rotor: Rotation) -> SynchronousNotch | None:
    """Return `notch_from` of an axis for a rotor whose numbers may be arrays.

    `controller`: the common table with the keys of its bearing.
    """
    try:
        notch = notch_from(Table({"controller": controller}), case.scenario)
    except ValueError as error:
        raise ValueError(f"{case.name}: {error}") from None
    return notch and following(notch, rotor)


def _speeds(table: Table, rotor: Rotor, duration: float) -> tuple[float, ...]:
    """Return sensitivity.speeds, rpm; by default the first, the last and the largest of the run."""
    if "speeds" in table.raw:
        return tuple(listed_speeds(table, MOST_SPEEDS))
    first, *between, last = (float(rotor.rotation.rpm(t)) for t in rotor.rotation.corners(duration))
    ends = (first,) if first == last else (first, last)
    most = max(between, key=abs, default=0.0)
    return (*ends, most) if abs(most) > max(abs(first), abs(last)) else ends


def _start(table: Table, rotor: Rotor, count: int) -> tuple[np.ndarray, list[float]]:
    """Return the coordinates [n] and the currents [c] (A) at t = 0. `count`: number of axes.

    initial.q gives all coordinates, or the rigid ones alone. initial.i is a number for all axes, or a list of one each.
    """
    table.only(["q", "i"])
    n, given = len(rotor.gravity), table.raw.get("q", [])
    q = np.zeros(n)
    length = n if isinstance(given, list) and len(given) == n else RIGID
    if isinstance(given, list) and given and len(given) != length:
        sizes = " or ".join(map(str, sorted({RIGID, n})))
        raise ValueError(f"{table.at('q')} has {len(given)} numbers: it must have {sizes}, those of all coordinates.")
    q[:length] = vector(table, "q", length, np.zeros(length))
    current = table.raw.get("i", 0.0)
    return q, vector(table, "i", count).tolist() if isinstance(current, list) else [current] * count


def _check_rank(rotor: Rotor, axes: list[BearingAxis]) -> None:
    """Raise ValueError if magnets or sensors leave a coordinate free that moves, directly or through others.

    A rigid coordinate without magnet, sensor and force stays at rest, such as the tilt of a rotor with one bearing at
    its centre of mass.
    """
    M, D, G, K = (np.asarray(x) for x in (rotor.M, rotor.D, rotor.G, rotor.K))
    every = [np.asarray(rows)[:, :RIGID] for rows in (rotor.at_magnets, rotor.at_sensors)]
    turning = [np.asarray(x) for one in rotor.unbalances for x in (one.along_x, one.along_y)]
    loads = [np.asarray(one.along) for one in rotor.loads]
    pushed = np.any([np.asarray(rotor.gravity), *loads, *turning], 0)
    moved = pushed | np.any([*rotor.at_magnets, *rotor.at_sensors], 0)
    linked = np.linalg.matrix_power(np.any([M, D, G, K], 0).astype(float), len(M)) > 0  # directly or through others
    needed = np.flatnonzero((linked @ moved)[:RIGID])
    for rigid, what in zip(every, ("magnets", "sensors"), strict=True):
        if free := [k for k in needed if not np.any(rigid[:, k])]:
            other = ", or leave out the weight, load or unbalance that acts on it" if np.any(pushed[free]) else ""
            names = ", ".join(COORDINATES[k] for k in free)
            raise ValueError(f"bearing: no axis holds {names}. Give a bearing whose {what} act on it{other}.")
        scale = np.abs(rigid[:, needed]).max(0)
        rank = int(np.linalg.matrix_rank(rigid[:, needed] / scale, tol=1e-9))
        if rank < len(needed):
            raise ValueError(
                f"bearing: the {what} of the {len(axes)} axes determine {rank} of the {len(needed)} rigid motions "
                f"({', '.join(COORDINATES[k] for k in needed)}). Place radial bearings at two different places."
            )


def _shares(rotor: Rotor) -> tuple[list[float], list[float]]:
    """Return the mass (kg) and the weight (N) that each axis carries [c]: 1/(b M^-1 b), and least-norm forces."""
    B, M, gravity = (np.asarray(x, np.float64) for x in (rotor.at_magnets, rotor.M, rotor.gravity))
    B = B[:, :RIGID]
    masses = 1 / np.sum(B * np.linalg.solve(M[:RIGID, :RIGID], B.T).T, 1)
    forces = np.linalg.pinv(B.T) @ -gravity[:RIGID]
    return masses.tolist(), np.where(np.abs(forces) > 1e-12 * np.abs(forces).max(), forces, 0.0).tolist()


def _clock(cases: list[Case], rotor: Rotor, fixed: bool) -> Clock:
    """Return the clock with a method whose fixed steps resolve every axis, the bending modes and nutation."""
    clock, period = cases[0].clock, float(cases[0].clock.sample_period)
    methods = [case.clock.method for case in cases]
    fixed_steps = [method for method in methods if isinstance(method, (RK4, DOP853, Euler))]
    if len(fixed_steps) == len(methods):
        most = max(fixed_steps, key=lambda method: method.substeps)
    else:
        slope = max(max(slopes(case.cascade, case.scenario).values()) for case in cases)
        most = RK4(max(math.ceil(period * slope / ACCURATE), 1))
    W = rotor.rotation.fastest(float(clock.duration))
    M, K, G = (np.asarray(x) for x in (rotor.M, rotor.K, rotor.G))
    fastest = max(math.sqrt(float(np.max(np.diag(K) / np.diag(M)))), float(W * np.max(np.abs(G) / np.diag(M)[:, None])))
    signals = tuple(one.signal for one in (*rotor.loads, *rotor.base))
    load = 2 * math.pi * max((high for _, high in frequencies_of(signals)), default=0.0)
    on_stop = stop_slope(rotor, cases)
    if fixed:
        require_stable(most, period / most.substeps, most.limit, {"fastest mode of the rotor": fastest, STOP: on_stop})
        return clock.with_method(most)
    needed = period * max(fastest / MODE, on_stop / TOUCHED, max(load, float(W)) / DRIVEN)
    substeps = max(most.substeps, math.ceil(needed))
    if substeps > MOST_SUBSTEPS:
        raise ValueError(
            f"clock: this machine needs {substeps} steps in a sample of {period:g} s; at most {MOST_SUBSTEPS} are "
            "allowed. Use a processor or smooth gains, leave out the fastest modes, or shorten clock.sample_period."
        )
    return clock.with_method(dataclasses.replace(most, substeps=substeps))
