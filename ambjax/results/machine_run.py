"""Simulate the case of a whole machine."""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.table import file_to_write
from ambjax.compiler.short_compilation import QUICKEST, compiled_quickly
from ambjax.ensemble.machines import compiled_for_machines
from ambjax.ensemble.replay import SEGMENT
from ambjax.numerics.records import canonical
from ambjax.numerics.shapes import stack_axes
from ambjax.simulation.folds import PerAxis
from ambjax.simulation.metrics import UNITS, Metrics
from ambjax.simulation.rollout import begin, finish, recorded_segment
from ambjax.simulation.trajectory import SIGNAL_UNITS, STATUSES, TOUCHED

# Metrics of which the smallest value of the axes is the worst.
SMALLEST = ("singular_at_s", "lost_at_s")


@dataclasses.dataclass(frozen=True)
class MachineRun:
    """The result of a simulation of a machine.

    - `signals`: t (s) [N], q [N, coordinates] (m or rad), speed_rpm [N], and by name each signal of the axes [N, axes].
    - `metrics`: each metric by name, of the worst axis; under "axes", the metrics of each axis by its name.
    - `lost_why`: why the rotor was lost; empty if it is held.
    """

    case: MachineCase
    signals: dict[str, np.ndarray]
    metrics: dict[str, Any]
    lost_why: str

    @property
    def lost(self) -> bool:
        """Whether the rotor is lost."""
        return bool(self.metrics["lost"])

    def save(self, path: str | pathlib.Path) -> None:
        """Write the signals to an .npz file, in SI units. Raises ValueError for a directory that does not exist."""
        np.savez_compressed(file_to_write("save", path), **self.signals)  # pyright: ignore[reportArgumentType]

    def plot(self) -> Any:
        """Return a matplotlib Figure with the motion, the currents and the voltages of all axes, and the orbits."""
        from ambjax.pictures.machine_pictures import machine_figure

        return machine_figure(self.case, self.signals, self.case.name)


_begun = compiled_quickly(begin, options=QUICKEST)
_segment = compiled_for_machines(recorded_segment, static_argnames=("count",))
_finished = compiled_quickly(finish, options=QUICKEST)


def simulate_machine(case: MachineCase, progress: Callable[[int], object] = lambda samples: None) -> MachineRun:
    """Simulate a machine, as `simulate` does."""
    fold = PerAxis(
        stack_axes([canonical(Metrics.of(case.settle, one.scenario, case.machine.near)) for one in case.cases])
    )
    machine, clock, fold = canonical((case.machine, case.clock, fold))
    state, parts, count = _begun(machine, clock, fold), [], min(SEGMENT, clock.samples)
    for first in range(0, clock.samples, count):
        state, rows = _segment(machine, clock, fold, state, np.asarray(first), count=count)
        left = min(count, clock.samples - first)
        parts.append(jax.tree.map(lambda x, left=left: np.asarray(x)[:left], rows))
        progress(left)
    rows = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    outcome = _finished(state, None, fold)
    signals = {"t": rows.t, "axes": np.array(case.axes), "coordinates": np.array(case.coordinates), "q": rows.q}
    signals |= {"speed_rpm": rows.speed * 30 / np.pi}
    signals |= {name: np.asarray(getattr(rows.axes, name), np.float64) for name in SIGNAL_UNITS if name != "t"}
    status = outcome.trajectory
    if case.machine.near == "z_stop":
        signals["z_stop"] = np.asarray(rows.axes.z_stop, np.float64)
    measured, why = {name: np.asarray(x) for name, x in outcome.metrics.items()}, STATUSES[int(status.lost_code)]
    if status.lost_code == TOUCHED:
        why += f" on the axis {case.axes[int(np.argmax(measured['clearance_used']))]}"
    signals |= {"lost_at": np.asarray(status.lost_at), "lost_why": np.asarray(why)}
    by_axis = {axis: {name: x[k].item() for name, x in measured.items()} for k, axis in enumerate(case.axes)}
    worst = {name: x.item() for name, x in worst_of(measured).items()}
    return MachineRun(case, signals, worst | {"axes": by_axis}, why)


def worst_of(measured: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return each metric [..., c] of the worst axis; without phases, of which none is the worst."""
    sized = {name: x for name, x in measured.items() if UNITS.get(name) != "deg"}
    return {name: np.min(x, -1) if name in SMALLEST else np.max(x, -1) for name, x in sized.items()}
