"""Simulate a case of one axis or of a machine, and return the result as tables and pictures."""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any, overload

import jax
import numpy as np

from ambjax.cases.case_table import notebook_table
from ambjax.cases.given import of_case
from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.cases.table import file_to_write
from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.control.cascade import Cascade
from ambjax.ensemble.machines import compiled_for_machines
from ambjax.ensemble.replay import SEGMENT, record_member
from ambjax.host.extensions import extra
from ambjax.numerics.records import canonical
from ambjax.numerics.shapes import stack_axes
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import PerAxis
from ambjax.simulation.metrics import UNITS, Metrics
from ambjax.simulation.rollout import begin, finish, recorded_segment
from ambjax.simulation.trajectory import SIGNAL_UNITS, STATUSES, TOUCHED, Trajectory
from ambjax.world.scenario import Scenario

Progress = Callable[[int], object]
# Metrics of which the smallest value of the axes is the worst.
SMALLEST = ("singular_at_s", "lost_at_s")


@dataclasses.dataclass(frozen=True)
class CaseRun:
    """The result of `simulate`. A notebook shows it as the table of its metrics.

    `trajectory`: the signals of the case at every sample, and the status of the rotor. `metrics`: each metric by name,
    in the SI unit of `UNITS`.
    """

    case: Case
    trajectory: Trajectory
    metrics: dict[str, Any]

    @property
    def lost(self) -> bool:
        """Whether the rotor is lost."""
        return bool(self.metrics["lost"])

    def to_pandas(self) -> Any:
        """Return the signals as a pandas DataFrame with one row per sample; the index is the time t, s.

        `attrs["units"]` contains the unit of each column. Raises ValueError if pandas is not installed.
        """
        index = extra("pandas").Index(np.asarray(self.trajectory.rows.t), name="t")
        frame = extra("pandas").DataFrame(self._signals(), index=index)
        frame.attrs["units"] = {name: SIGNAL_UNITS[name] for name in frame.columns}
        return frame

    def to_xarray(self) -> Any:
        """Return the signals as an xarray Dataset over t (s), each with its unit in `attrs`.

        Raises ValueError if xarray is not installed.
        """
        xarray = extra("xarray")
        signals = {name: ("t", x, {"units": SIGNAL_UNITS[name]}) for name, x in self._signals().items()}
        t = ("t", np.asarray(self.trajectory.rows.t), {"units": "s"})
        return xarray.Dataset(signals, {"t": t}, {"case": self.case.name, "lost_why": self.trajectory.lost_why})

    def save(self, path: str | pathlib.Path) -> None:
        """Write the signals to a file: .npz, .mat (MATLAB version 5), .csv or .parquet (extra `[tables]`).

        Each signal is an array by its name, in SI units. Raises ValueError for another ending, for a directory that
        does not exist, and for .parquet without pyarrow.
        """
        path = file_to_write("save", path)
        arrays = {name: x for name, x in self.trajectory.arrays().items() if name in SIGNAL_UNITS}
        if path.suffix == ".npz":
            self.trajectory.save(path)
        elif path.suffix == ".mat":
            import scipy.io

            scipy.io.savemat(path, arrays, oned_as="column")
        elif path.suffix == ".csv":
            table = np.column_stack(list(arrays.values()))
            np.savetxt(path, table, "%.17g", ",", header=",".join(arrays), comments="")
        elif path.suffix == ".parquet":
            extra("pyarrow")
            self.to_pandas().reset_index().to_parquet(path)
        else:
            raise ValueError(f"save: {path}: the file must end in .npz, .mat, .csv or .parquet.")

    def plot(self) -> Any:
        """Return a matplotlib Figure with the main signals: the whole run, its start and its end."""
        from ambjax.pictures.overview import overview_figure

        method = self.case.clock.method
        title = self.case.name if method is None else f"{self.case.name}: {method}"
        return overview_figure(self.trajectory, title, settle=self.case.settle)

    def plot_phase(self) -> Any:
        """Return a matplotlib Figure of the velocity against the displacement, in the whole run and when settled."""
        from ambjax.pictures.figures import phase_plane

        return phase_plane(self.trajectory, self.case.name, self.case.settle)

    def _signals(self) -> dict[str, np.ndarray]:
        return {name: x for name, x in self.trajectory.arrays().items() if name in SIGNAL_UNITS and name != "t"}

    def _repr_html_(self) -> str:
        why = self.trajectory.lost_why
        ended = f"the rotor is lost: {why}" if self.lost else f"not decided, {why}" if why else "the rotor is held"
        rows = [(name, f"{value:.6g}", UNITS.get(name, "")) for name, value in self.metrics.items()]
        return notebook_table(f"{self.case.name}: {ended}", ("metric", "value", "unit"), rows)


@dataclasses.dataclass(frozen=True)
class MachineRun:
    """The result of a simulation of a machine.

    `signals`: t (s) [N], q [N, coordinates] (m or rad), speed_rpm [N], and by name each signal of the axes [N, axes].
    `metrics`: each metric by name, of the worst axis; under "axes", the metrics of each axis by its name. `lost_why`:
    why the rotor was lost; empty if it is held.
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


_begun = compiled_quickest(begin)
_segment = compiled_for_machines(recorded_segment, static_argnames=("count",))
_finished = compiled_quickest(finish)


def simulate_machine(case: MachineCase, progress: Progress = lambda samples: None) -> MachineRun:
    """Simulate a machine, as `simulate` does."""
    folds = [canonical(Metrics.of(case.settle, one.scenario, case.machine.near)) for one in case.cases]
    fold = PerAxis(stack_axes(folds))
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


@overload
def simulate(case: MachineCase, progress: Progress = ...) -> MachineRun: ...
@overload
def simulate(case: Case, progress: Progress = ...) -> CaseRun: ...
@overload
def simulate(case: Cascade, scenario: Scenario, clock: Clock, /, progress: Progress = ...) -> CaseRun: ...
@of_case(machines=True)
def simulate(case: Case | MachineCase, progress: Progress = lambda samples: None) -> CaseRun | MachineRun:
    """Simulate a case or a machine, as `ambjax simulate` does, and record every sample.

    - `case`: from `read_case` or `read_machine`; or a cascade, a scenario and a clock.
    - `progress`: called with the number of new samples after each part of the run.

    Returns a `CaseRun`, or a `MachineRun` of a machine. A lost rotor is no error: see `CaseRun.lost`. Nor is a stalled
    run: see the metric `stalled`. For derivatives and batches use `rollout`. Raises ValueError for anything but a case,
    and as `rollout` does.

        run = ambjax.simulate(ambjax.read_case("my.toml"))
        run.metrics["settled_rms_error_m"]  # m
    """
    if not callable(progress):
        raise ValueError(f"progress = {progress!r}: it must be a function of the number of new samples.")
    if isinstance(case, MachineCase):
        return simulate_machine(case, progress)
    fold = Metrics.of(case.settle, case.scenario)
    outcome = record_member(case.cascade, case.scenario, case.clock, fold=fold, tell=progress)
    metrics = {name: np.asarray(x).item() for name, x in outcome.metrics.items()}
    return CaseRun(case, outcome.trajectory, metrics)
