"""The weights of the LQG of a machine that are tuned."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.machine_linear import LqgProblem, lqg_problem
from ambjax.cases.table import Table
from ambjax.control.lqg import LqgWeights
from ambjax.extend import canonical
from ambjax.simulation.whole_machine import Machine
from tuning.problem.gains_table import chosen
from tuning.problem.space import Space

ROOT = "controller.lqg."
# Not tuned by default: the design depends only on the ratios of the noises to this weight.
REFERENCE = f"{ROOT}force"


class Weight(NamedTuple):
    """A weight: its dotted path in [tune] and in the case file."""

    path: str

    @property
    def where(self) -> str:
        return self.path


class LqgSpace(NamedTuple):
    """The weights of an LQG that are tuned: a `Space`, and the design."""

    space: Space
    problem: LqgProblem

    @property
    def gains(self) -> list[Weight]:
        return [Weight(path) for path in self.space.paths]

    def values(self, _case: MachineCase) -> np.ndarray:
        """Return the weights [m] of the case."""
        return np.array([self.problem.weights[path.removeprefix(ROOT)] for path in self.space.paths])

    def decode(self, x: np.ndarray, machine: Machine) -> Machine:
        """Return the machine with the weights at coordinates x [m]. Its law is not finite if there is no design."""
        values = np.asarray(self.space.gains_at(jnp.asarray(x))).tolist()
        found = dict(zip((path.removeprefix(ROOT) for path in self.space.paths), values, strict=True))
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
    known = {ROOT + one.name: (0.0, float(one.metadata["at_most"])) for one in dataclasses.fields(LqgWeights)}
    off = [ROOT + name for name, weight in problem.weights.items() if not weight > 0]
    return LqgSpace(
        chosen(table, known, [path for path in known if path not in (REFERENCE, *off)], off, "machine"), problem
    )
