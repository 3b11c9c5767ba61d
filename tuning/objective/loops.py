"""Quantities of the linearised loops of members, and their derivatives with respect to the coordinates of the gains."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.ensemble import apply, map_members
from ambjax.extend import Scalar, canonical
from ambjax.linear import LoopQuantities, linearisation_inputs, loop_matrices, loop_quantities
from ambjax.world.scenario import Scenario
from tuning.objective.members import LoopRange, Members, Objective
from tuning.space import Space

# Lanes of one call of the compiled program.
LANES = 8


class LoopLane(NamedTuple):
    """One linearisation: coordinates `x` [m], and the results of `linearisation_inputs` for one member."""

    x: Any
    cascade: Cascade
    scenario: Scenario
    period: Scalar


@dataclasses.dataclass(frozen=True)
class LaneLoop:
    """Function of a lane that returns the LoopQuantities at the equilibrium of r = 0, and their derivatives [m]."""

    space: Space
    range: LoopRange

    def __call__(self, lane: LoopLane) -> tuple[LoopQuantities, LoopQuantities]:
        def quantities(x: Array) -> tuple[LoopQuantities, LoopQuantities]:
            cascade = self.space.decode(x, lane.cascade)
            names, *numbers = self.range
            matrices = loop_matrices(cascade, lane.scenario, lane.period, 0.0)
            found = loop_quantities(*matrices, *numbers, delay="delay_margin_s" in names)
            return found, found

        slopes, values = jax.jacfwd(quantities, has_aux=True)(lane.x)
        return values, slopes


def loops(objective: Objective, x: np.ndarray, members: Members) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the limited quantities [S, N] by name at coordinates x [S, m] for members [N], and derivatives [S, N, m].

    The gains of stressed members are not shifted. Raises ValueError as `rollout` does.
    """
    assert objective.loop is not None
    count, n = len(x), len(members.member)
    cascade, scenario = objective.cascade, objective.scenario
    if members.values:
        cascade, scenario = apply(cascade, scenario, members.values)
    lane = LoopLane(None, *linearisation_inputs(cascade, scenario, objective.clock))
    start, member = np.divmod(np.arange(count * n), n)
    lane = jax.tree.map(lambda a: np.asarray(a)[member] if np.ndim(a) else a, canonical(lane))
    lane = lane._replace(x=np.asarray(x, jnp.result_type(float))[start])
    function = LaneLoop(objective.space, objective.loop)
    # one call at a time: XLA runs LAPACK on its own threads, and two calls wait for each other for ever
    values, slopes = map_members(function, lane, threads=1, call=LANES, block=LANES, plain=True)
    names = objective.loop.names
    return (
        {name: getattr(values, name).reshape(count, n) for name in names},
        {name: getattr(slopes, name).reshape(count, n, -1) for name in names},
    )
