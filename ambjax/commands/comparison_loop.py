"""The loops of a comparison: their laws, the numbers of the linearised loops, and the one that the picture shows."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ambjax.cases.machine_case import AnyCase, MachineCase
from ambjax.ensemble.paths import kinds, places
from ambjax.linear import MachineSensitivity, StateSpace
from ambjax.results.operating import OperatingPoint, SpreadPeaks, analysis_summary


class ComparedLoop(NamedTuple):
    """The linearised loops of a case.

    - `numbers`: of the nominal loop, or of the worst axis and speed of a machine, by the keys of the summary: "stable"
      (None: not known), and others.
    - `axes`: peak of |S| and zone of each axis of a machine by its name, at the worst speed; {} for one axis.
    - `system`: the loop that the picture shows; None: not stable, or no equilibrium. `channel`, `command`:
      numbers of the reading and the voltage that the picture shows, among its outputs.
    """

    numbers: Mapping[str, object]
    axes: Mapping[str, Mapping[str, object]] = {}
    system: StateSpace | None = None
    channel: int = 0
    command: int = 2

    @property
    def stable(self) -> bool:
        """Whether the nominal loop is stable, at each speed of a machine."""
        return bool(self.numbers["stable"])


def loop_of_axis(point: OperatingPoint, peaks: SpreadPeaks | None) -> ComparedLoop:
    """Return the loop of a case of one axis. `peaks`: sensitivity peaks of the members; None without a spread."""
    numbers: dict[str, object] = {"stable": point.stable, "zone": point.zone}
    if peaks is not None:
        numbers["unstable"] = peaks.members - peaks.stable
        if not numbers["unstable"] and peaks.point is not None and peaks.point.analysis.stable:
            numbers["worst_peak"] = peaks.point.analysis.S.height
    loop = point.analysis
    if not loop.stable:
        return ComparedLoop(numbers)
    at, outside = loop.margins_at, loop.S.outside
    numbers |= analysis_summary(loop) | {
        "zone": loop.zone,
        "stiffness_N_per_m": loop.stiffness,
        "outside_peak": None if outside is None else outside.height,
        "delay_margin_reading_s": at.reading.delay,
        "delay_margin_command_s": at.command.delay,
    }
    return ComparedLoop(numbers, system=point.system)


def loop_of_machine(points: Sequence[MachineSensitivity]) -> ComparedLoop:
    """Return the loops of a machine: the largest peaks and the smallest margins of its axes at its speeds."""
    if not all(point.stable for point in points):
        return ComparedLoop({"stable": False, "zone": "D"})
    if not all(point.linear for point in points):  # stable, but without peaks
        return ComparedLoop({"stable": True})
    rows = [(axis, point) for point in points for axis in point.axes]
    worst, at = max(rows, key=lambda row: row[0].S.height)
    margins = [axis.margins for axis, _ in rows if axis.margins is not None]
    numbers = {
        "stable": True,
        "peak": worst.S.height,
        "frequency_hz": worst.S.frequency,
        "zone": worst.zone,
        "worst_at": f"{worst.name} at {at.speed:g} rpm",
        "sigma_max": max(point.sigma.height for point in points),
        "t_peak": max(axis.T.height for axis, _ in rows),
        "ks_peak": max(axis.KS.height for axis, _ in rows),
        "gain_margin_low": max(one.gm_low for one in margins),
        "gain_margin_high": min(one.gm_high for one in margins),
        "phase_margin_deg": min(one.pm for one in margins),
        "delay_margin_reading_s": min(one.delay for one in margins),
        "disk_margin": min(one.dm for one in margins),
        "outside_peak": max((axis.S.outside.height for axis, _ in rows if axis.S.outside is not None), default=None),
    }
    axes = {}
    for axis in at.axes:
        own = max((other for other, _ in rows if other.name == axis.name), key=lambda other: other.S.height)
        axes[axis.name] = {"peak": own.S.height, "frequency_hz": own.S.frequency, "zone": own.zone}
    k = at.axes.index(worst)
    return ComparedLoop(numbers, axes, at.system, k, len(at.axes) + k)


def laws_of(case: AnyCase) -> dict[str, dict[str, object]]:
    """Return the kind and the numbers of each law by stage, or by axis and stage of a machine."""
    if isinstance(case, MachineCase):
        whole = case.machine.law
        laws = {} if whole is None else {"all axes": {"kind": type(whole).__name__}}
        own = [(axis, laws_of(one)) for axis, one in zip(case.axes, case.cases, strict=True)]
        replaced = () if whole is None else ("observer", "position")
        return laws | {f"{axis} {at}": law for axis, of in own for at, law in of.items() if at not in replaced}
    laws: dict[str, dict[str, object]] = {}
    for path, kind in kinds(case.cascade, "controller."):
        if path.endswith(".kind") and path.count(".") == 2:
            laws[path.split(".")[1]] = {"kind": kind}
    for path, place in places(case.cascade, case.scenario).items():
        _, stage, *rest = path.split(".") if path.startswith("controller.") else ("", "")
        if rest and place.value is not None and stage != "model":
            laws[stage][".".join(rest)] = float(place.value)
    return {stage: laws[stage] for stage in laws if stage not in ("model", "processor")}
