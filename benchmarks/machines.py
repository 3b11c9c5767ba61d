"""Ensembles of a whole machine, compared with the machine's limit: machines.c.

The rotor, its magnets, unbalance and load are those of `ambjax template machine` at 20 kHz, with the paper's cascade on
every axis, measured velocities, held noise and one sample of delay with prediction. Further rows have bending modes or
more bearings. `agreement` compares machines.c with `rollout.run` under the same sensor errors. One core, float64;
processor seconds, measured alternately, without compilation. Run: python benchmarks/machines.py
"""

import ctypes
import functools
import math
import os
import pathlib
import subprocess
import tempfile
import tomllib
from typing import Any, NamedTuple

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import jax.numpy as jnp
import limit
import numpy as np

from ambjax.cases.machine_case import MachineCase, machine_from
from ambjax.cases.template_text import template
from ambjax.ensemble.machines import run_machines
from ambjax.results.machine_study import MachineStudy
from ambjax.simulation.folds import Peak, PerAxis

MEMBERS, SAMPLES, REPEATS = 1024, 500, 9
# Vectors that machines.c interleaves, of which two are faster with smooth signs and one with set-valued signs.
CHAINS = {False: 2, True: 1}
SOURCE = pathlib.Path(__file__).with_name("machines.c")
# Places (m) of the radial bearings, in the order in which they are added.
PLACES = {"left": -0.139, "right": 0.241, "third": -0.06, "fourth": 0.12}
# Frequencies (Hz) of the bending modes and their shapes at the places.
MODES = (
    (150.0, (0.6, -0.5, 0.1, 0.4)),
    (300.0, (-0.3, 0.4, 0.5, -0.2)),
    (450.0, (0.2, 0.3, -0.4, 0.1)),
    (600.0, (-0.2, 0.1, 0.3, 0.3)),
)
AXIS = (
    *limit.PLANT.split(),
    *["touchdown", "c", "k", "p_sigma", "gamma", "p_v", "k_i", "p_e", "u_max", "sample_period"],
)


class Kind(NamedTuple):
    """A machine: numbers of radial bearings, of thrust bearings and of bending modes a plane, substeps, and signs."""

    radial: int = 2
    thrust: int = 1
    modes: int = 0
    substeps: int = 2
    hard: bool = False

    @property
    def axes(self) -> int:
        return 2 * self.radial + self.thrust

    @property
    def coordinates(self) -> int:
        return 5 + 2 * self.modes


# The machines with stated limits of the ratio, and then those that show the cost of axes and modes.
# With set-valued signs and 4 modes a plane, 2 of 1,024 members are lost under the noise of machines.c: no such row.
LIMITS = (Kind(), Kind(hard=True), Kind(modes=4))
AXES = tuple(Kind(radial, thrust) for radial, thrust in ((2, 0), (2, 1), (3, 1), (4, 1)))
BENDING = tuple(Kind(modes=modes) for modes in (0, 1, 2, 4))


def case_of(kind: Kind, samples: int) -> MachineCase:
    """Return the case of a machine."""
    raw = tomllib.loads(template("machine"))
    axial = [one for one in raw["bearing"] if one["kind"] == "axial"]
    radial = [{"name": name, "kind": "radial", "at": at} for name, at in list(PLACES.items())[: kind.radial]]
    for n, one in enumerate(radial):
        if kind.modes:
            one["modes"] = [shapes[n] for _, shapes in MODES[: kind.modes]]
        else:
            one["sensor_at"] = one["at"] + 0.02 * (n == 0)
    raw["bearing"] = radial + axial[: kind.thrust]
    if kind.modes:
        raw["rotor"] |= {"kind": "modal", "modes": [{"frequency": f, "damping": 0.01} for f, _ in MODES[: kind.modes]]}
    period = raw["clock"]["sample_period"]
    raw["clock"] = {"duration": samples * period, "sample_period": period, "dt": period / kind.substeps}
    raw["load"][0]["start"] = round(0.4 * samples) * period
    signs = {"p": math.inf} if kind.hard else {}
    raw["controller"] = {
        "position": {"kind": "sliding-mode", **signs},
        "inversion": {"kind": "adaptive", **signs},
        "current": {"kind": "sliding-mode", **signs},
    }
    raw["processor"] |= {"guard": False}
    raw["sensor"] = {"std": 2e-7, "std_z_dot": 2e-4, "std_i": 1e-3}
    raw["run"] = {"settle": 0.0}
    raw.pop("sensitivity")
    return machine_from(raw)


def problem_type(kind: Kind) -> type[ctypes.Structure]:
    """Return struct problem of machines.c for a machine."""
    double, n = ctypes.c_double, kind.coordinates

    class Axis(ctypes.Structure):
        _fields_ = [(name, double) for name in AXIS]

    class Problem(ctypes.Structure):
        _fields_ = [
            *((name, double) for name in ["sample_period", "touchdown", "W", "load", "std_z", "std_z_dot", "std_i"]),
            *((name, ctypes.c_int64) for name in ["substeps", "samples", "load_from", "seed"]),
            *((name, double * n) for name in ["per_mass", "damping", "stiffness"]),
            ("gyroscopic", double),
            *((name, double * n) for name in ["weight", "along_x", "along_y", "along", "start_q"]),
            *((name, double * n * kind.axes) for name in ("magnets", "sensors")),
            ("axes", Axis * kind.axes),
        ]

    return Problem


def axis_numbers(case: Any, period: float) -> dict[str, float]:
    """Return the numbers of struct axis."""
    scenario, plant = case.scenario, case.scenario.plant
    _, position, inversion, current = (vars(law) for law in case.cascade.laws)
    found = {name: getattr(plant, name) for name in limit.PLANT.split()}
    found |= {"touchdown": scenario.limit, "u_max": scenario.u_max, "sample_period": period}
    found |= {"g": case.cascade.model.g, "c": position["c"], "k": position["k"], "gamma": inversion["gamma"]}
    return found | {"k_i": current["k_i"], "p_sigma": position["p"], "p_v": inversion["p"], "p_e": current["p"]}


def problem_of(kind: Kind, case: MachineCase) -> ctypes.Structure:
    """Return the numbers of a case for machines.c."""
    rotor, clock, sensor = case.machine.rotor, case.clock, case.cases[0].scenario.sensors
    (unbalance,), (load,), (M, D, K) = rotor.unbalances, rotor.loads, map(np.asarray, (rotor.M, rotor.D, rotor.K))
    assert all(np.array_equal(x, np.diag(np.diag(x))) for x in (M, D, K)), "machines.c takes diagonal matrices"
    assert unbalance.phase == rotor.acceleration == 0
    W, found = float(rotor.speed_at(0.0)), problem_type(kind)()
    amount = 1e-6 * float(unbalance.amount)
    numbers: dict[str, Any] = {
        "sample_period": clock.sample_period,
        "touchdown": case.cases[0].scenario.limit,
        "W": W,
        "load": vars(load.signal)["amplitude"],
        "std_z": sensor.std,
        "std_z_dot": sensor.std_z_dot,
        "std_i": sensor.std_i,
        "substeps": vars(clock.method)["substeps"],
        "samples": clock.samples,
        "load_from": round(vars(load.signal)["start"] / clock.sample_period),
        "gyroscopic": W * np.asarray(rotor.G)[3, 4],
    }
    rows: dict[str, Any] = {
        "per_mass": 1 / np.diag(M),
        "damping": np.diag(D),
        "stiffness": np.diag(K),
        "weight": rotor.gravity,
        "along_x": amount * np.asarray(unbalance.along_x),
        "along_y": amount * np.asarray(unbalance.along_y),
        "along": load.along,
        "start_q": case.machine.start_q,
    }
    for name, value in numbers.items():
        setattr(found, name, type(getattr(found, name))(value))
    for name, value in rows.items():
        getattr(found, name)[:] = np.asarray(value, float).tolist()
    for name, value in (("magnets", rotor.at_magnets), ("sensors", rotor.at_sensors)):
        for n, row in enumerate(np.asarray(value, float).tolist()):
            getattr(found, name)[n][:] = row
    for n, one in enumerate(case.cases):
        for name, value in axis_numbers(one, float(clock.sample_period)).items():
            setattr(found.axes[n], name, math.inf if value is None else float(value))
    return found


@functools.cache
def library(kind: Kind) -> Any:
    """Return machines.c, compiled for a machine."""
    sizes = [f"-DRADIAL={kind.radial}", f"-DTHRUST={kind.thrust}", f"-DMODES={kind.modes}"]
    sizes.append(f"-DCHAINS={CHAINS[kind.hard]}")
    with tempfile.TemporaryDirectory() as folder:
        path = str(pathlib.Path(folder, "machines.so"))
        command = ["gcc", *limit.FLAGS.split(), *limit.PRECISION["float64"].split(), *sizes, str(SOURCE), "-o", path]
        subprocess.run([*command, "-lm"], check=True, capture_output=True, text=True)
        return ctypes.CDLL(path)


def by_c(kind: Kind, problem: ctypes.Structure, members: int, errors: np.ndarray | None = None) -> np.ndarray:
    """Return the largest |z| at the magnets of each member [members, axes], m. `errors` [samples, axes, 3, members]."""
    peak, lost = np.zeros((members, kind.axes)), np.zeros(members)
    given = None if errors is None else ctypes.c_void_p(errors.ctypes.data)
    pointers = [ctypes.c_void_p(x.ctypes.data) for x in (peak, lost)]
    if library(kind).run(ctypes.byref(problem), ctypes.c_long(members), *pointers, given):
        raise ValueError("machines.c: too many substeps")
    assert not lost.any(), f"{kind}: the rotor is lost"
    return peak


def ensemble(kind: Kind, members: int, samples: int, every: bool = False) -> tuple[MachineCase, Any]:
    """Return the case and its arguments of `run_machines`. `every`: all metrics, not only the largest |z|."""
    case = case_of(kind, samples)
    study, numbers = MachineStudy(case, 0, members), np.arange(members)
    machine, fold = study.varied(study.drawn(numbers), numbers)
    return case, (machine, case.clock, fold if every else PerAxis(Peak("z", jnp.zeros(kind.axes))))


def errors_of(kind: Kind, members: int, samples: int) -> np.ndarray:
    """Return the sensor errors of an ensemble, [samples, axes, 3, members]."""
    study = MachineStudy(case_of(kind, samples), 0, members)

    def one(member: int) -> Any:
        machine = study.member(member).machine.realised()
        drawn = jax.vmap(lambda n: machine.join(machine.sensor_errors(n))[:3])(jnp.arange(samples))
        return np.stack([np.asarray(x) for x in drawn], 2)

    return np.ascontiguousarray(np.stack([one(n) for n in range(members)], 3), np.float64)


def agreement(kind: Kind, members: int = 9, samples: int = 200) -> float:
    """Return the relative error of machines.c in the largest |z|; AssertionError beyond 1e-10."""
    case, arguments = ensemble(kind, members, samples)
    expected = run_machines(*arguments, threads=1).metrics
    found = by_c(kind, problem_of(kind, case), members, errors_of(kind, members, samples))
    error = float(np.max(np.abs(found / expected - 1)))
    assert error <= 1e-10, f"machines.c is off by {error:.1e}: {kind}"
    return error


@functools.cache
def measure(kind: Kind) -> dict[str, Any]:
    """Return one row: a machine, with the agreement with machines.c if it is one of LIMITS."""
    case, arguments = ensemble(kind, MEMBERS, SAMPLES)
    problem = problem_of(kind, case)
    runs: dict[str, Any] = {"ambjax": lambda: run_machines(*arguments, threads=1).metrics}
    runs |= {"C": lambda: by_c(kind, problem, MEMBERS)}
    found = _measure.alternating(runs, REPEATS, clock=_measure.own_seconds)
    row: dict[str, Any] = {**kind._asdict(), "axes": kind.axes, "members": MEMBERS, "samples": SAMPLES}
    row |= {name: 1e9 * each.seconds / MEMBERS / SAMPLES for name, each in found.items()}
    row |= {"ratio": found["ambjax"].over(found["C"]), "compile_s": found["ambjax"].compile_s}
    if kind in LIMITS:
        row["error"] = agreement(kind)
    print(
        f"{kind}: ambjax {row['ambjax']:.0f} ns a sample, C {row['C']:.0f}, ratio {row['ratio']:.2f}; compiled in "
        f"{row['compile_s']:.0f} s; agreement {row.get('error', math.nan):.0e}",
        flush=True,
    )
    return row


def main() -> None:
    _measure.one_core()
    groups = {"limits": LIMITS, "axes": AXES, "modes": BENDING}
    rows = {name: [measure(kind) for kind in kinds] for name, kinds in groups.items()}
    _measure.write("machines", rows)


if __name__ == "__main__":
    main()
