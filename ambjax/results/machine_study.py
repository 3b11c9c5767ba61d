"""An ensemble of a machine: its study, whose metrics are those of the worst axis."""

import dataclasses
import hashlib
from typing import Any

import jax
import numpy as np

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.machine_controller import inner
from ambjax.cases.machine_spread import axis_values, machine_places, varied_rotors
from ambjax.compiler.members_last import members_last
from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import map_members
from ambjax.ensemble.paths import kinds, places, with_values
from ambjax.ensemble.spread import Spread, drawn
from ambjax.ensemble.study import SPREAD, AnyStudy
from ambjax.linear import linearise_machine, poles_in_s
from ambjax.linear.stability import Findings
from ambjax.numerics.records import canonical
from ambjax.results.machine_run import worst_of
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import Fold
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.rollout import Result, prepare, run
from ambjax.simulation.whole_machine import Machine, PerAxis, machine_of, stack_axes
from ambjax.world.rotor import Rotor
from ambjax.world.scenario import Scenario

# Multiple of the clearance by which the rotor of a `lost` call is displaced along x and y.
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

    - `case`: the machine, with its spread.
    - `seed`: seed of the spread and of the noise.
    - `members`: number of members.
    """

    case: MachineCase
    seed: int
    members: int

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
        known = machine_places(self.case.machine.rotor, self.case.axes, self.case.cases)
        return drawn(self.spread, known, self.seed, members, self.members)

    def batch(self, members: np.ndarray) -> tuple[Machine, PerAxis]:
        """Return the machine of these members (integers [n]), and the metrics of its axes; what varies has an axis [n].

        The nominal plants of the controllers do not vary.
        """
        values = self.drawn(members)
        parts = [self._axis(values, k, members) for k in range(len(self.case.axes))]
        machine = self._machine(varied_rotors(self.case.machine.rotor, values), parts)
        return machine, PerAxis(stack_axes([canonical(Metrics.of(self.settle, scenario)) for _, scenario in parts]))

    def _machine(self, rotor: Rotor, parts: list[tuple[Cascade, Scenario]]) -> Machine:
        law = self.case.machine.law
        systems = [prepare(*part, self.clock)[0] for part in parts]
        systems = [canonical(system if law is None else inner(system, law)) for system in systems]
        return machine_of(rotor, systems, self.case.machine.start_q, law)

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
        rotor = self.case.machine.rotor
        rotors = varied_rotors(rotor, values)
        if rotors is not rotor:
            rotor = jax.tree.map(lambda x: x[0], rotors)
        machine = self._machine(rotor, [(one.cascade, one.scenario) for one in cases])
        name = f"{self.case.name}-{index}"
        return dataclasses.replace(self.case, name=name, machine=machine, cases=tuple(cases))

    def columns(
        self, start: int, stop: int, *, call: int | None = None, threads: int | None = None, lost: bool = False
    ) -> dict[str, Any]:
        members = np.arange(start, stop)
        machine, fold = self.batch(members)
        if lost:
            far = np.array(machine.start_q)
            far[:2] = FAR * max(float(np.max(np.asarray(one.scenario.limit))) for one in self.case.cases)
            machine = dataclasses.replace(machine, start_q=far)
        outcome = run_machines(machine, self.clock, fold, threads=threads, call=call)
        values = {SPREAD + path: x for path, x in self.drawn(members).items()}
        return {"index": members, "lost_at": outcome.trajectory.lost_at, **worst_of(outcome.metrics), **values}

    def findings(self, index: np.ndarray) -> Findings:
        """Test whether the linear loops of the first MOST_TESTED of these members are stable at their first speed."""
        growth = []
        for k in index[:MOST_TESTED]:
            one = self.member(int(k))
            speed = float(np.asarray(one.machine.rotor.speed))
            growth.append(np.max(np.real(poles_in_s(linearise_machine(one.machine, self.clock.sample_period, speed)))))
        return LinearFindings(len(growth), int(np.sum(np.array(growth) > 0)))

    def fingerprint(self) -> dict[str, object]:
        facts, digest = self.facts(), hashlib.sha256()
        for k, one in enumerate(self.case.cases):
            at = f"bearing.{self.case.axes[k]}."
            facts |= {**dict(kinds(one.cascade, f"{at}controller.")), **dict(kinds(one.scenario, at))}
        known = machine_places(self.case.machine.rotor, self.case.axes, self.case.cases)
        facts |= {path: str(place.value) for path, place in known.items()}
        for x in jax.tree.leaves((self.case.machine.rotor, self.case.machine.start_q)):
            digest.update(np.asarray(x).tobytes())
        return facts | {"rotor": digest.hexdigest()}


def run_machines(
    machine: Machine, clock: Clock, fold: Fold, *, threads: int | None = None, call: int | None = None
) -> Result:
    """Simulate every member of an ensemble of machines. What varies has a leading axis [N]. No rows are recorded."""
    tree = canonical((machine, clock, fold))
    return map_members(_simulated, tree, threads=threads, call=call, vectorised=True)


def _simulated(tree: tuple[Machine, Clock, Fold], axes: object) -> Result:
    return members_last(lambda one: run(*one, 0), axes)(tree)
