"""Quantities of the linearised loops of members, and their derivatives with respect to the coordinates of the gains."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.compiler.short_compilation import compiled_quickly
from ambjax.control.cascade import Cascade
from ambjax.ensemble import apply, map_members
from ambjax.extend import Scalar, canonical
from ambjax.linear import LoopQuantities, linearisation_inputs, loop_matrices, loop_quantities
from ambjax.world.rotation import PER_MINUTE
from ambjax.world.scenario import Scenario
from tuning.problem.members import LoopRange, Members, Objective
from tuning.problem.quantities import LOOPS
from tuning.problem.space import Space


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
    duration: float

    def __call__(self, lane: LoopLane) -> tuple[LoopQuantities, LoopQuantities]:
        def quantities(x: Array) -> tuple[LoopQuantities, LoopQuantities]:
            cascade = self.space.decode(x, lane.cascade)
            names, *numbers = self.range
            matrices = loop_matrices(cascade, lane.scenario, lane.period, 0.0)
            speeds, rotor = None, lane.scenario.rotor
            if "sensitivity_1x" in names and rotor is not None:  # at the start and the end of the run, Hz
                speeds = jnp.abs(jnp.stack([rotor.rpm(t) for t in (0.0, self.duration)])) * PER_MINUTE
            found = loop_quantities(*matrices, *numbers, delay="delay_margin_s" in names, speeds=speeds)
            return found, found

        slopes, values = jax.jacfwd(quantities, has_aux=True)(lane.x)
        return values, slopes


def loops(
    objective: Objective, x: np.ndarray, members: Members, also: tuple[str, ...] = ()
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the limited quantities [S, N] by name at coordinates x [S, m] for members [N], and derivatives [S, N, m].

    `also`: names of further quantities of `LoopQuantities`. The gains of stressed members are not shifted. Raises
    ValueError as `rollout` does.
    """
    assert objective.loop is not None
    count, n = len(x), len(members.member)
    cascade, scenario = objective.cascade, objective.scenario
    if members.values:
        cascade, scenario = apply(cascade, scenario, members.values)
    lane = LoopLane(None, *linearisation_inputs(cascade, scenario, objective.clock))
    start, member = np.divmod(np.arange(count * n), n)
    lane = jax.tree.map(lambda a: np.asarray(a)[member] if np.ndim(a) else a, canonical(lane))
    at = np.asarray(x, jnp.result_type(float))[start]
    lane = lane._replace(x=at, cascade=objective.notched(at, lane.cascade))
    function = LaneLoop(objective.space, objective.loop, float(objective.clock.duration))
    # one call at a time: XLA runs LAPACK on its own threads, and two calls wait for each other for ever
    values, slopes = map_members(function, lane, threads=1, call=LOOPS, block=LOOPS, compiled=compiled_quickly)
    names = (*objective.loop.names, *also)
    return (
        {name: getattr(values, name).reshape(count, n) for name in names},
        {name: getattr(slopes, name).reshape(count, n, -1) for name in names},
    )


def check_loops(objective: Objective, x: np.ndarray, members: Members) -> None:
    """Raise ValueError if limits concern linearised loops and no member has one at any of the coordinates x [S, m]."""
    if objective.loop is None:
        return
    for some in (x[:1], x[1:]):  # most often the first point decides
        if len(some) and np.isfinite(loops(objective, some, members, also=("growth",))[0]["growth"]).any():
            return
    raise ValueError(
        f"tune.limits: {', '.join(objective.loop.names)} cannot be evaluated, because the loop has an equilibrium, and "
        f"there a linearisation, at none of the {len(x)} starting points. `ambjax sensitivity` names the cause. Change "
        "the laws or their gains, or remove these limits."
    )
