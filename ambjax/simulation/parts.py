"""A rollout in parts, for reverse mode: if N samples have a divisor near sqrt(N), its memory grows with sqrt(N)."""

import functools
import math
from typing import Any

import jax
from jax import Array, lax

from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import Fold
from ambjax.simulation.rollout import Result, RolloutState, System, begin, finish, segment


def rolled_in_parts(system: System, clock: Clock, fold: Fold) -> Result:
    """Simulate a rollout without rows. Reverse mode recomputes each part (`jax.checkpoint`).

    Reverse mode stores the state at the start of each part and, for one part at a time, the state at each sample. The
    result is that of `rollout.run`, up to rounding. `clock` must have fixed steps. The function is not jitted.
    """
    system, clock, fold = canonical((system.realised(), clock, fold))
    # the number of samples of a part: the largest divisor of `samples` that is at most its square root
    length = next(one for one in range(math.isqrt(clock.samples), 0, -1) if clock.samples % one == 0)

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def part(progress: RolloutState, first: Array, system: Any, clock: Clock, fold: Fold) -> RolloutState:
        return segment(system, clock, fold, progress, first, length, 0)[0]

    advanced = lambda number, progress: part(progress, number * length, system, clock, fold)  # noqa: E731
    progress = lax.fori_loop(0, clock.samples // length, advanced, begin(system, clock, fold))
    return finish(progress, None, fold)
