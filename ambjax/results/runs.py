"""Simulate a case, and return the result as tables and pictures."""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any, overload

import numpy as np

from ambjax.cases.case_table import notebook_table
from ambjax.cases.given import of_case
from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.cases.table import file_to_write
from ambjax.control.cascade import Cascade
from ambjax.ensemble.replay import record_member
from ambjax.host.extensions import extra
from ambjax.results.machine_run import MachineRun, simulate_machine
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import UNITS, Metrics
from ambjax.simulation.trajectory import SIGNAL_UNITS, Trajectory
from ambjax.world.scenario import Scenario

Progress = Callable[[int], object]


@dataclasses.dataclass(frozen=True)
class CaseRun:
    """The result of `simulate`.

    - `case`: the case that was simulated.
    - `trajectory`: its signals at every sample, and the status of the rotor.
    - `metrics`: each metric by name, in the SI unit of `UNITS`.

    A notebook shows it as the table of its metrics.
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
        frame = extra("pandas").DataFrame(
            self._signals(), index=extra("pandas").Index(np.asarray(self.trajectory.rows.t), name="t")
        )
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
        """Return the saved signals [samples] by name, without the time."""
        return {name: x for name, x in self.trajectory.arrays().items() if name in SIGNAL_UNITS and name != "t"}

    def _repr_html_(self) -> str:
        """Return the table of the metrics, with the status of the rotor as its caption."""
        why = self.trajectory.lost_why
        ended = f"the rotor is lost: {why}" if self.lost else f"not decided, {why}" if why else "the rotor is held"
        rows = [(name, f"{value:.6g}", UNITS.get(name, "")) for name, value in self.metrics.items()]
        return notebook_table(f"{self.case.name}: {ended}", ("metric", "value", "unit"), rows)


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
