"""The search: a screen, then many starts refined at once; interrupted, resumed and repeated alike."""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.host.interrupts import deferred, raise_if_interrupted
from tuning.objective.goal import Goal
from tuning.objective.lanes import Engine
from tuning.objective.loss import TERMS
from tuning.objective.members import Members
from tuning.optimisers import BFGS
from tuning.search.descent import Descent
from tuning.search.evolution import begun, clouds
from tuning.search.iteration import iterate, record
from tuning.search.keeper import Keeper, SearchState
from tuning.search.screen import screen

# A start has converged when its next step is shorter than this.
SHORTEST = 1e-3
# After these iterations of a phase the better half of the starts goes on.
HALVINGS = (4, 10)
# Points of the first phase's path that are tried on all members.
PATH = 12


class Phase(NamedTuple):
    """One ordinary member in `part` is simulated, and all that must be held: what loses them is a cliff.

    A descent has converged when the goal fell by less than `stall` over `patience` iterations. Where its gradient is
    larger than `rise` then, CMA-ES goes on.
    """

    part: int
    stall: float
    patience: int
    rise: float


# A start whose gradient promises a factor e of the goal within the shortest step does not descend.
STEEP = 1 / SHORTEST
# On few members first: what they need is nearly what all need, at less than half of the cost. The gradient of the goal,
# a logarithm, vanishes at a minimum: converged descents of benchmarks/tasks end at norms of 0.001 to 0.02 per factor e
# of a gain, those that stopped short at 0.36 to 1e127.
FEW, ALL = Phase(4, 0.02, 3, STEEP), Phase(1, 1e-3, 4, 0.1)
# What the first Ctrl-C says.
ENDING = "the search ends after this iteration; what it found is judged and written."


def search(
    engine: Engine,
    goal: Goal,
    who: Members,
    points: np.ndarray,
    *,
    keep: int = 1,
    iterations: int,
    name: str = BFGS,
    rate: float = 0.1,
    seed: int = 0,
    settled: bool = False,
    keeper: Keeper | None = None,
    resume: bool = False,
    tell: Callable[[SearchState, float], None] = lambda search, seconds: None,
) -> SearchState:
    """Refine the best `keep` of these points, coordinates [K, m]. Ctrl-C ends it early.

    Where there are more points than that, they are screened and refined on a part of the members first; the best point
    on the way there, the first of `points` included, goes on with all; unless that is the first and `settled`: an
    earlier search on all members has ended there. At most `iterations` in each of these phases. A start descends, or
    goes on by CMA-ES where its derivatives mislead, with populations drawn from `seed`. `tell` is called after each
    iteration with the search and the seconds that it took.
    """
    descent = Descent(goal, name, rate)
    keeper = keeper or Keeper(None, {})
    phases = [FEW, ALL] if len(points) > keep else [ALL]
    given, began = points[0], time.perf_counter()
    progress = keeper.load(descent, min(keep, len(points)), points.shape[1]) if resume else None
    if progress is not None:
        engine.rollouts = int(progress.history["rollouts"][-1])
    else:
        if len(points) > keep:
            points = screen(engine, who, points, keep, goal)[:keep]
        starts = descent.begin(jnp.asarray(points))
        progress = SearchState(starts, np.ones(len(points), bool))
    try:
        while True:
            # Before there is anything to judge, Ctrl-C ends the process as elsewhere.
            with deferred(ENDING if progress.history else ""):
                raise_if_interrupted()
                before = progress.seconds
                if not progress.active.any() or progress.iteration - progress.since >= iterations:
                    if progress.phase + 1 == len(phases):
                        break
                    _go_on_with_all(engine, goal, who, progress, descent, given, settled)
                if progress.active.any():
                    phase = phases[progress.phase]
                    iterate(engine, goal, who.part(phase.part, 1), progress, descent, seed=seed)
                    _switch(progress, phase)
                progress.seconds = progress.earlier + time.perf_counter() - began
                keeper.save(progress)
                tell(progress, progress.seconds - before)
    except KeyboardInterrupt:
        progress.interrupted = True
    return progress


def _switch(progress: SearchState, phase: Phase) -> None:
    """Which starts go on, and which of them by CMA-ES.

    Not those whose steps have become tiny or whose loss stalls, nor the worse half in time. A descent whose derivatives
    mislead goes on by CMA-ES: those of a chaotic loop grow from sample to sample and do not describe the goal, and
    at an edge, beyond which members are lost, a descent stops short of a minimum.
    """
    starts, count = progress.starts, progress.iteration - progress.since
    value, rise, active = np.asarray(starts.value), np.asarray(starts.rise), progress.active
    evolving = progress.evolving
    ended = np.asarray(starts.length) <= SHORTEST
    converged = np.array([progress.cloud(at).converged for at in range(len(active))])
    # few members suffice to choose among populations, not to refine them
    chosen = phase.part > 1 and count >= HALVINGS[-1]
    ended |= np.where(evolving, converged | chosen, _stalled(progress, phase.patience, phase.stall))
    turns = active & ~evolving & ~((rise < STEEP) & ((rise < phase.rise) | ~ended))
    active = active & (~ended | turns)
    if count in HALVINGS:
        order = np.argsort(np.where(active, value, np.inf), kind="stable")
        active[order[max((int(active.sum()) + 1) // 2, 1) :]] = False
    for at in np.flatnonzero(turns & active):
        progress.put(at, begun(np.asarray(starts.best)[at]))
    progress.active = active


def _stalled(progress: SearchState, patience: int, stall: float) -> np.ndarray:
    """Whether the goal of each start [S] fell by less than `stall` over so many iterations of this phase."""
    if progress.iteration - progress.since <= patience:
        return np.zeros(len(progress.active), bool)
    past, value = progress.history["value"][-1 - patience], np.asarray(progress.starts.value)
    return np.isfinite(past) & (past - np.where(np.isfinite(value), value, 0.0) < stall)


def _go_on_with_all(
    engine: Engine,
    goal: Goal,
    who: Members,
    progress: SearchState,
    descent: Descent,
    given: np.ndarray,
    settled: bool = False,
) -> None:
    """Begin the next phase from one point: that on the paths of all starts, or `given`, which is best for all members.

    The answer for a part of the members may lose others: then an earlier point is better, and on the right side of
    that cliff. The phase ends as it begins where `given` is best, and `settled`.
    """
    x, value = (np.array(progress.history[name][progress.since :]) for name in ("x", "value"))
    starts = value.shape[1]
    x, value = x.reshape(-1, x.shape[-1]), value.ravel()
    _, first = np.unique(np.where(np.isfinite(value), value, np.inf), return_index=True)
    # the best ones, and fewer and fewer of the others
    chosen = first[np.unique((np.linspace(0, np.sqrt(len(first) - 1), PATH).round(6) ** 2).astype(int))]
    tried = np.concatenate([x[chosen], given[None]])
    terms = engine.terms(tried, who)
    values = goal.score(tried, terms, who)
    best = int(np.argsort(values, kind="stable")[0])
    start = int(chosen[best] % starts) if best < len(chosen) else 0
    at = np.array(progress.starts.best)
    at[start] = tried[best]
    progress.starts = descent.anew(jnp.asarray(at), progress.starts)
    progress.clouds = clouds(*at.shape)
    progress.active = np.arange(starts) == start
    progress.phase, progress.since = progress.phase + 1, progress.iteration
    if settled and best == len(chosen):
        value = np.where(progress.active, values[best], np.inf)
        progress.starts = progress.starts._replace(state=progress.starts.state._replace(value=jnp.asarray(value)))
        progress.active = np.zeros(starts, bool)
        record(engine, who, progress, {start: {name: terms[name][best] for name in TERMS}}, fresh=True)


def best_of(progress: SearchState) -> tuple[np.ndarray, float]:
    """Coordinates [m] and goal of the best point seen in this phase."""
    value = np.asarray(progress.starts.value)
    at = int(np.argmin(value))
    return np.asarray(progress.starts.best)[at], float(value[at])
