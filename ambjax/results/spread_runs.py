"""Simulate members of the spread of a case, and return the results as tables and pictures."""

import dataclasses
import numbers
from typing import Any, overload

import numpy as np

from ambjax.cases.case_table import notebook_table
from ambjax.cases.given import names_arguments, of_case
from ambjax.cases.machine_case import MachineCase, first_axis
from ambjax.cases.reader import Case
from ambjax.ensemble import statistics
from ambjax.ensemble.design import MOST_MEMBERS
from ambjax.ensemble.study import AnyStudy, Study
from ambjax.host.extensions import extra
from ambjax.results.machine_study import MachineStudy
from ambjax.simulation.metrics import UNITS


@dataclasses.dataclass(frozen=True)
class MembersRun:
    """The result of `simulate_members`: the study and its columns by name, arrays [members] in SI units.

    The columns are index, lost_at, every metric, and "spread." + path for each quantity of the spread.
    """

    study: AnyStudy
    columns: dict[str, np.ndarray]

    @property
    def survivors(self) -> int:
        """Number of members that are neither lost nor stalled."""
        return int(np.isposinf(self.columns["lost_at"]).sum())

    def summary(self) -> dict[str, Any]:
        """Return the statistics of the study, with confidence intervals: see `ambjax.ensemble.summary`."""
        return statistics.summary(self.columns, self.study.spread.paths, self.study.seed)

    def to_pandas(self) -> Any:
        """Return the columns as a pandas DataFrame, one row per member.

        `attrs["units"]` has the unit of each metric.
        """
        columns = {name: x for name, x in self.columns.items() if name != "index"}
        index = extra("pandas").Index(self.columns["index"], name="member")
        frame = extra("pandas").DataFrame(columns, index=index)
        frame.attrs["units"] = {name: UNITS[name] for name in frame.columns if name in UNITS}
        return frame

    def _repr_html_(self) -> str:
        held = np.isposinf(self.columns["lost_at"])
        head = f"{self.survivors} of {held.size} members are held (seed {self.study.seed})"
        rows = [
            (name, f"{np.median(x[held]):.6g}", f"{x[held].max():.6g}", UNITS[name])
            for name, x in self.columns.items()
            if name in UNITS and held.any() and np.isfinite(x[held]).all()
        ]
        return notebook_table(head, ("metric", "median", "largest", "unit"), rows)

    def plot(self, *metrics: str) -> Any:
        """Return a matplotlib Figure with histograms of these metrics over the members.

        Raises ValueError if none of these names is a column.
        """
        from ambjax.pictures.ensembles import CHIEF, histogram_figure

        return histogram_figure(self.columns, metrics or CHIEF)


@of_case(machines=True)
@names_arguments()
def simulate_members(
    case: Case | MachineCase, members: int, *, seed: int | None = None, threads: int | None = None
) -> MembersRun:
    """Simulate members 0 to members - 1 of the spread of a case, as `ambjax ensemble` does.

    - `members`: number of members.
    - `seed`: of the spread and the noise; None: `run.seed` of the case.
    - `threads`: CPU cores to use; None: all.

    Returns a `MembersRun`, whose results stay in memory; `ambjax ensemble` writes them in parts and can be resumed.
    Raises ValueError for anything but a case, and for a number of members or a seed out of range.

        ambjax.simulate_members(case, 1000, seed=3).columns["settled_rms_error_m"]  # m, [members]
    """
    study = study_of(case, seed, members)
    columns = {name: np.asarray(x) for name, x in study.columns(0, members, threads=threads).items()}
    return MembersRun(study, columns)


@overload
def study_of(case: Case, seed: int | None, members: int) -> Study: ...
@overload
def study_of(case: MachineCase, seed: int | None, members: int) -> MachineStudy: ...
@overload
def study_of(case: Case | MachineCase, seed: int | None, members: int) -> Study | MachineStudy: ...
def study_of(case: Case | MachineCase, seed: int | None, members: int) -> Study | MachineStudy:
    """Return the study of a case. Raises ValueError for a member count or seed out of range."""
    if not isinstance(members, numbers.Integral) or not 1 <= members <= MOST_MEMBERS:
        raise ValueError(f"--members {members!r}: it must be a whole number from 1 to {MOST_MEMBERS:,}.")
    seed = int(first_axis(case).scenario.seed) if seed is None else seed
    if not isinstance(seed, numbers.Integral) or not 0 <= seed < 2**32:
        raise ValueError(f"--seed {seed!r}: it must be a whole number from 0 to 4294967295.")
    if isinstance(case, MachineCase):
        return MachineStudy(case, seed, members)
    return Study(case.cascade, case.scenario, case.clock, case.settle, case.spread, seed, members)
