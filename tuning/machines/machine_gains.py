"""The gains of a machine that are tuned: common to all axes or of one bearing; or the weights of its LQG."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.machine_linear import LqgProblem, lqg_problem
from ambjax.cases.table import Table
from ambjax.control.lqg import LqgWeights
from ambjax.extend import canonical
from ambjax.host.sealed import flat
from ambjax.simulation.machine_axes import loop_of
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.whole_machine import Machine
from tuning.problem.gains_table import chosen
from tuning.problem.space import Space, read, tunable, with_gain

BEARING = "bearing."
LQG = "controller.lqg."
# Not tuned by default: the design depends only on the ratios of the noises to this weight.
REFERENCE = f"{LQG}force"


@dataclasses.dataclass(frozen=True)
class MachineGain:
    """A gain of the axes with these numbers. `path`: in [tune]. `inner`: in the cascade. `where`: in the case file."""

    path: str
    inner: str
    where: str
    axes: tuple[int, ...]

    def values(self, case: MachineCase) -> list[float]:
        """Return the gain of each of its axes."""
        return [float(read(case.cases[k].cascade, self.inner)) for k in self.axes]


@dataclasses.dataclass(frozen=True)
class MachineSpace:
    """The gains of a machine: a `Space`, of which each gain is written to its axes."""

    space: Space
    gains: tuple[MachineGain, ...]

    @property
    def where(self) -> list[str]:
        """The paths of the gains in the case file."""
        return [gain.where for gain in self.gains]

    def values(self, case: MachineCase) -> np.ndarray:
        """Return the gains [m] of a case; of the axes of a gain, the geometric mean."""
        return np.array([math.exp(np.mean(np.log(gain.values(case)))) for gain in self.gains])

    def decode(self, x: Array, machine: Machine) -> Machine:
        """Return the machine with the gains at coordinates x [m]."""
        groups = list(machine.axes)
        for j, (own, gain) in enumerate(zip(self.gains, self.space.gains, strict=True)):
            for n, group in enumerate(machine.groups):
                at = np.array([k for k, axis in enumerate(group) if axis in own.axes], int)
                if at.size:
                    groups[n] = _written(groups[n], own.inner, at, gain.decode(x[j]))
        return dataclasses.replace(machine, axes=tuple(groups))


def _written(axis: Any, path: str, at: np.ndarray, value: Array) -> Any:
    """Return the stacked loops of a group with a gain of the axes `at` replaced."""
    loop = loop_of(axis)
    cascade = with_gain(loop.cascade, path, jnp.asarray(read(loop.cascade, path)).at[at].set(value))
    loop = dataclasses.replace(loop, cascade=cascade)
    return dataclasses.replace(axis, loop=loop) if isinstance(axis, Sampled) else loop


def machine_space(table: Table, case: MachineCase, raw: dict[str, Any]) -> MachineSpace:
    """Return the gains of the table [tune] of a machine.

    Without tune.gains, they are all gains of the position laws that are not 0, common to all axes. Raises ValueError
    for an unknown gain or an invalid bound.
    """
    known = _known(case, raw)
    unusable = [path for path, gain in known.items() if not all(0 < one < math.inf for one in gain.values(case))]
    default = [path for path in known if path.startswith("controller.position.") and path not in unusable]
    space = chosen(table, dict.fromkeys(known, (0.0, math.inf)), default, unusable, "machine")
    gains = tuple(known[path] for path in space.paths)
    taken = [(gain.inner, k) for gain in gains for k in gain.axes]
    for gain in gains:
        if any(taken.count((gain.inner, k)) > 1 for k in gain.axes) and not gain.path.startswith(BEARING):
            raise ValueError(f"{table.at('gains')}: {gain.path} and a bearing's own are both named. Keep one of them.")
    return MachineSpace(space, gains)


def _known(case: MachineCase, raw: dict[str, Any]) -> dict[str, MachineGain]:
    """Return every gain by path. A common gain belongs to the axes whose bearing does not give it itself."""
    bearings = Table(raw).tables("bearing")
    names = [table.raw.get("name", f"bearing{k + 1}") for k, table in enumerate(bearings)]
    each = [tunable(one.cascade, steepness=False) for one in case.cases]
    found: dict[str, MachineGain] = {}
    for path in dict.fromkeys(path for paths in each for path in paths):
        of = [k for k, paths in enumerate(each) if path in paths]
        common = []
        for number, (name, table) in enumerate(zip(names, bearings, strict=True)):
            axes = tuple(k for k in of if case.axes[k].rpartition(".")[0] == name)
            own = f"{BEARING}{name}.{path}"
            if axes:
                found[own] = MachineGain(own, path, f"bearing[{number}].{path}", axes)
            if path not in flat({"controller": table.raw.get("controller", {})}):
                common += axes
        if common:
            found[path] = MachineGain(path, path, path, tuple(common))
    return found


class LqgSpace(NamedTuple):
    """The weights of an LQG that are tuned: a `Space`, and the design."""

    space: Space
    problem: LqgProblem

    @property
    def where(self) -> list[str]:
        """The paths of the weights in the case file."""
        return self.space.paths

    def values(self, _case: MachineCase) -> np.ndarray:
        """Return the weights [m] of the case."""
        return np.array([self.problem.weights[path.removeprefix(LQG)] for path in self.space.paths])

    def decode(self, x: np.ndarray, machine: Machine) -> Machine:
        """Return the machine with the weights at coordinates x [m]. Its law is not finite if there is no design."""
        found = {path.removeprefix(LQG): value for path, value in self.space.named(x).items()}
        try:
            law = self.problem.law(self.problem.weights | found)
        except ValueError:
            law = jax.tree.map(lambda leaf: jnp.full_like(leaf, math.inf), machine.law)
        return dataclasses.replace(machine, law=canonical(law))


def lqg_space(table: Table, case: MachineCase, raw: dict[str, Any]) -> LqgSpace:
    """Return the weights of the table [tune] of a machine with an LQG; without tune.gains, all but the force.

    Raises ValueError for an unknown weight or an invalid bound.
    """
    problem = lqg_problem(Table(raw), case.cases, case.machine.rotor)
    known = {LQG + one.name: (0.0, float(one.metadata["at_most"])) for one in dataclasses.fields(LqgWeights)}
    off = [LQG + name for name, weight in problem.weights.items() if not weight > 0]
    return LqgSpace(
        chosen(table, known, [path for path in known if path not in (REFERENCE, *off)], off, "machine"), problem
    )
