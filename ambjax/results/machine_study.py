"""An ensemble of a machine: its study, whose metrics are those of the worst axis."""

import contextlib
import dataclasses
import hashlib
import math
import tomllib
from collections.abc import Mapping
from typing import Any, Self

import jax
import numpy as np

from ambjax.cases.machine_case import MachineCase, machine_from, machine_of_axes, notched, parts_of, with_notches_for
from ambjax.cases.machine_spread import axis_values, machine_places, shared, varied_start
from ambjax.cases.rotor_numbers import OF_BEARING, SPEED, varied_rotors
from ambjax.cases.table import put
from ambjax.control.cascade import Cascade
from ambjax.ensemble.machines import run_machines
from ambjax.ensemble.paths import Place, kinds, places, with_values
from ambjax.ensemble.spread import Spread, drawn
from ambjax.ensemble.study import PERIOD, AnyStudy
from ambjax.linear.linear_machine import turning_machines
from ambjax.linear.machine_stability import growth_of, machine_stability
from ambjax.linear.notch_design import speeds_of
from ambjax.linear.stability import Findings, Stability
from ambjax.numerics.records import canonical
from ambjax.numerics.shapes import map_varying, stack_axes
from ambjax.results.runs import worst_of
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import PerAxis
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.whole_machine import Machine
from ambjax.world.rotor import Rotor
from ambjax.world.scenario import Scenario

# Multiple of the clearance by which the rotor of a `lost` call is displaced along x, y and z.
FAR = 4.0
# Largest number of members whose linearised loops are tested.
MOST_TESTED = 16


class LinearFindings(Findings):
    """Findings of the linearised loops alone."""

    def words(self) -> str:
        if self.stable:
            return f"The linearised loops of all {self.tested} members tested are stable."
        return f"The linearised loops of {self.unstable} of {self.tested} members tested are NOT stable."


@dataclasses.dataclass(frozen=True)
class MachineStudy(AnyStudy):
    """The definition of an ensemble of a machine. Member k depends on (seed, k), as in `Study`.

    `by_axis`: metrics of each axis among the columns, as AXIS.METRIC.
    """

    case: MachineCase
    seed: int
    members: int
    by_axis: tuple[str, ...] = ()

    @property
    def clock(self) -> Clock:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.case.clock

    @property
    def settle(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.case.settle

    @property
    def spread(self) -> Spread:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.case.spread

    @property
    def random(self) -> bool:
        return any(one.scenario.random for one in self.case.cases)

    def drawn(self, members: np.ndarray) -> dict[str, np.ndarray]:
        return drawn(self.spread, self._numbers(), self.seed, members, self.members)

    def _numbers(self) -> dict[str, Place]:
        machine = self.case.machine
        return machine_places(machine.rotor, machine.start_q, self.case.axes, self.case.cases)

    def places(self) -> dict[str, Place]:
        table = self._numbers()
        for path, parts in shared(table, self.case.axes).items():
            first = table[parts[0]]
            same = all(np.array_equal(table[part].value, first.value) for part in parts)
            table[path] = first if same else first._replace(value=None)
        return table

    def parts(self, path: str) -> tuple[str, ...]:
        return shared(self._numbers(), self.case.axes).get(path, (path,))

    def rereads(self, path: str) -> bool:
        """Return whether the defaults, or the law of the machine, may be designed with this number of the file."""
        first, *rest = path.split(".")
        nominal = (rest[1:] if first == OF_BEARING else [first, *rest])[:-1] == ["controller", "model"]
        return path == PERIOD or first == "processor" or nominal

    def at(self, path: str, value: float) -> Self:
        case, notches = _reread(self.case, {path: value}), [one.cascade.notch for one in self.case.cases]
        case = dataclasses.replace(case, cases=notched(case.cases, notches))
        case = with_notches_for(case, gain_speeds(self.case))
        return self._with_clock(case, case.clock.with_method(self.clock.method))

    def _with_clock(self, case: MachineCase, clock: Clock) -> Self:
        return dataclasses.replace(self, case=dataclasses.replace(case, clock=clock))

    def with_steps_for(self, axes: dict[str, np.ndarray]) -> Self:
        """Return the study with integration steps, and gains of the notches, for all values of these numbers.

        `axes`: the values by dotted path of `places`.
        """
        wide: dict[str, object] = {}
        for path, x in axes.items():
            low, high = float(x.min()), float(x.max())
            wide |= {PERIOD: high} if path == PERIOD else {f"spread.{path}": {"uniform": [low, high]}}
        try:
            found = _reread(self.case, wide)
        except ValueError as error:
            raise ValueError(f"--x, --y: {error}") from None
        turning = any(path in SPEED for path in axes)  # the notches are designed for these speeds
        case = dataclasses.replace(found, spread=self.case.spread) if turning else self.case
        return self._with_clock(case, self.clock.with_method(found.clock.method))

    def notch_gains(self, values: dict[str, float]) -> dict[str, float]:
        """Return the gains of the notches by dotted path, designed for the nominal machine with these values.

        They are NaN if that machine has no linearisation.
        """
        cases = [dataclasses.replace(one, cascade=self._axis(values, k, 0)[0]) for k, one in enumerate(self.case.cases)]
        with contextlib.suppress(ValueError):
            found = with_notches_for(dataclasses.replace(self.case, cases=tuple(cases)), gain_speeds(self.case))
            return _gains(found)
        return dict.fromkeys(_gains(self.case), math.nan)

    def varied(self, values: dict[str, np.ndarray], members: np.ndarray) -> tuple[Machine, PerAxis]:
        """Return the machine with these values and random signals of these members [n], and the metrics of its axes.

        What varies has an axis [n].
        """
        machine, (rotor, start) = self.case.machine, self._rotor(values)
        parts = [self._axis(values, k, members) for k in range(len(self.case.axes))]
        folds = [canonical(Metrics.of(self.settle, scenario, machine.near)) for _, scenario in parts]
        return machine_of_axes(rotor, parts, self.clock, start, machine.law), PerAxis(stack_axes(folds))

    def metrics(
        self, values: dict[str, np.ndarray], members: np.ndarray, *, lost: bool = False, **how: Any
    ) -> dict[str, np.ndarray]:
        machine, fold = self.varied(values, members)
        if lost:
            far = np.array(machine.start_q)
            far[..., :3] = FAR * max(float(np.max(np.asarray(one.scenario.limit))) for one in self.case.cases)
            machine = dataclasses.replace(machine, start_q=far)
        outcome = run_machines(machine, self.clock, fold, **how)
        columns = {"lost_at": np.asarray(outcome.trajectory.lost_at), **worst_of(outcome.metrics)}
        for k, axis in enumerate(self.case.axes):
            columns |= {f"{axis}.{name}": outcome.metrics[name][:, k] for name in self.by_axis}
        return columns

    def _rotor(self, values: dict[str, np.ndarray]) -> tuple[Rotor, np.ndarray]:
        machine = self.case.machine
        return varied_rotors(machine.rotor, values, self.case.axes), varied_start(machine.start_q, values)

    def _axis(self, values: dict[str, Any], k: int, member: Any) -> tuple[Cascade, Scenario]:
        one = self.case.cases[k]
        own = axis_values(values, self.case.axes[k], places(one.cascade, one.scenario))
        cascade, scenario = with_values(one.cascade, one.scenario, own)
        return cascade, dataclasses.replace(scenario, seed=self.seed, member=member)

    def member(self, index: int) -> MachineCase:
        """Return the case of one member; all leaves are those of one machine."""
        values = self.drawn(np.array([index]))
        numbers, cases = {path: float(x[0]) for path, x in values.items()}, []
        for k, one in enumerate(self.case.cases):
            cascade, scenario = self._axis(numbers, k, index)
            cases.append(dataclasses.replace(one, cascade=cascade, scenario=scenario))
        machine, (rotor, start) = self.case.machine, self._rotor(values)
        if rotor is not machine.rotor:
            rotor = jax.tree.map(lambda x: x[0], rotor)
        start = start.reshape(-1, start.shape[-1])[0]
        machine = machine_of_axes(rotor, parts_of(cases), self.clock, start, machine.law)
        name = f"{self.case.name}-{index}"
        return dataclasses.replace(self.case, name=name, machine=machine, cases=tuple(cases))

    def findings(self, index: np.ndarray) -> Findings:
        """Test whether the machines of the first MOST_TESTED of these members are stable."""
        tested = index[:MOST_TESTED]
        stable, found = self._stability(self.drawn(tested), tested)
        return LinearFindings(len(tested), int(np.sum(~stable))) if found is None else found.findings()

    def stable(self, values: dict[str, np.ndarray], members: np.ndarray) -> np.ndarray:
        """Return whether each system of `varied` is stable [n] (`machine_stability`); not without an equilibrium.

        They are tested at the speeds of the run, and at those of the case unless the speed varies.
        """
        return self._stability(values, members)[0]

    def _stability(self, values: dict[str, np.ndarray], members: np.ndarray) -> tuple[np.ndarray, Stability | None]:
        """Return `stable`, and the stability of each system at its worst speed; None: the linear loops decide."""
        machine, _ = self.varied(values, members)
        given = () if any(path in SPEED for path in values) else self.case.speeds
        at, rates = list[tuple[int, float]](), list[float]()
        for k in range(len(members)):
            one = map_varying(lambda x, k=k: x[k], machine)
            speeds = {*speeds_of(one.rotor.rotation, float(self.clock.duration)), *given}
            own = [math.inf] * len(speeds)
            with contextlib.suppress(ValueError):
                own = [growth_of(point.system) for point in turning_machines(one, self.clock.sample_period, speeds)]
            at += [(k, speed) for speed, _ in zip(speeds, own, strict=False)]
            rates += own
        found, growth = machine_stability(machine, self.clock, at, np.array(rates)), np.array(rates)
        of, stable = np.array([k for k, _ in at], int), growth <= 0 if found is None else found.stable
        every = np.array([stable[of == k].all() for k in range(len(members))])
        if found is None:
            return every, None
        order = np.lexsort((-found.swing, found.stable, of))  # of each member, the worst speed first
        return every, found.of(order[np.unique(of[order], return_index=True)[1]])

    def fingerprint(self) -> dict[str, object]:
        machine, facts = self.case.machine, self.facts()
        for k, one in enumerate(self.case.cases):
            at = f"bearing.{self.case.axes[k]}."
            facts |= {**dict(kinds(one.cascade, f"{at}controller.")), **dict(kinds(one.scenario, at))}
        facts |= {path: str(place.value) for path, place in self._numbers().items()}
        for name, part in (("rotor", machine.rotor), ("initial.q", machine.start_q), ("controller.law", machine.law)):
            digest = hashlib.sha256(repr(jax.tree.structure(part)).encode())
            for x in jax.tree.leaves(part):
                digest.update(np.asarray(x).tobytes())
            facts[name] = digest.hexdigest()[:12]
        return facts


def gain_speeds(case: MachineCase) -> list[float]:
    """Return the speeds (rpm) of the gains of all notches."""
    notches = (one.cascade.notch for one in case.cases)
    return [float(gain.speed) for notch in notches if notch for gain in notch.gains]


def _gains(case: MachineCase) -> dict[str, float]:
    notches = {axis: one.cascade.notch for axis, one in zip(case.axes, case.cases, strict=True)}
    return {
        f"{OF_BEARING}.{axis}.controller.notch.gains.{k}.{name}": float(getattr(gain, name))
        for axis, notch in notches.items() if notch
        for k, gain in enumerate(notch.gains) for name in ("real", "imaginary")
    }  # fmt: skip


def _reread(case: MachineCase, changes: Mapping[str, object]) -> MachineCase:
    """Return a machine with other values at dotted paths of its file. Raises ValueError as `machine_from` does."""
    if not case.text:
        raise ValueError(f"{case.name}: it has no file. Read it with read_machine.")
    raw = tomllib.loads(case.text)
    for path, value in changes.items():
        if path.startswith("controller.model."):  # on all axes
            for one in raw["bearing"]:
                put(one, path.split("."), value)
        elif path.startswith(f"{OF_BEARING}."):
            _, name, own = path.split(".", 2)
            names = [one.get("name", f"bearing{k + 1}") for k, one in enumerate(raw["bearing"])]
            put(raw["bearing"][names.index(name)], own.split("."), value)
        else:
            put(raw, path.split("."), value)
    return machine_from(raw, case.name, case.text, case.folder)
