"""The search: a screen, then the simultaneous refinement of several starts. A search can be interrupted and resumed."""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.host.interrupts import deferred, raise_if_interrupted
from tuning.optimisers import BFGS
from tuning.problem.goal import Goal
from tuning.problem.lanes import Engine
from tuning.problem.members import Members
from tuning.solve.checkpoint import CheckpointFile, SearchState
from tuning.solve.descent import Descent
from tuning.solve.evolution import idle_states, initial_state
from tuning.solve.iteration import iterate
from tuning.solve.screen import screen

# A start has converged if its next step, in coordinates, is shorter than this.
SHORTEST = 1e-3
# Numbers of iterations of a phase after which only the better half of the starts continues.
HALVINGS = (4, 10)
# Number of points of the first phase that are then evaluated on all members.
PATH_POINTS = 12


class Phase(NamedTuple):
    """A phase of the search.

    It simulates 1/`part` of the ordinary members. It simulates all stressed members, because the goal jumps where one
    of these is lost. A descent ends if the goal falls by less than `stall` over `patience` iterations. If the norm of
    its gradient is then `gradient_limit` or more, the start continues with CMA-ES.
    """

    part: int
    stall: float
    patience: int
    gradient_limit: float


# A start with a gradient above STEEP uses CMA-ES at once. Such a gradient predicts that the goal, a logarithm, changes
# by more than 1 within the shortest step.
STEEP = 1 / SHORTEST
# The first phase uses few members: their optimum is close to that of all members, at less than half of the cost. In
# the last phase, `gradient_limit` distinguishes converged descents from those that stop early. In benchmarks/tasks, the
# former end with gradients of norm 0.001 to 0.02, the latter with 0.36 to 1e127. The norm is the change of the goal, a
# logarithm, per factor e of a gain.
FEW, ALL = Phase(4, 0.02, 3, STEEP), Phase(1, 1e-3, 4, 0.1)
# Message at the first Ctrl-C.
INTERRUPT_MESSAGE = "the search ends after this iteration; its best gains are then judged and written."


def search(
    engine: Engine,
    goal: Goal,
    members: Members,
    points: np.ndarray,
    *,
    keep: int = 1,
    iterations: int,
    name: str = BFGS,
    rate: float = 0.1,
    seed: int = 0,
    checkpoint_file: CheckpointFile | None = None,
    resume: bool = False,
    until: float = math.inf,
    on_iteration: Callable[[SearchState, float], None] = lambda search, seconds: None,
) -> SearchState:
    """Refine the best `keep` of these points, coordinates [K, m]. Ctrl-C ends the search early.

    With at most `keep` points, all are refined on all members. With more, they are screened, and the best `keep` are
    refined on a part of the members. At most PATH_POINTS points of this phase, and the first of `points`, are then
    evaluated on all members, and the best of them is refined further. Each phase has at most `iterations`. A start
    descends by the optimiser `name` with the learning rate `rate`. If its gradient does not lead to a minimum, it
    continues with CMA-ES.

    `seed`: seed of the populations of CMA-ES. `on_iteration`: called after each iteration with the search and the
    duration of the iteration in s. `until`: time of `time.perf_counter` after which the search ends at its next
    iteration.
    """
    descent = Descent(goal, name, rate)
    checkpoint_file = checkpoint_file or CheckpointFile(None, {})
    phases = [FEW, ALL] if len(points) > keep else [ALL]
    given, began = points[0], time.perf_counter()
    progress = checkpoint_file.load(descent, min(keep, len(points)), points.shape[1]) if resume else None
    if progress is not None:
        engine.rollouts = int(progress.history["rollouts"][-1])
    else:
        if len(points) > keep:
            points = screen(engine, members, points, keep, goal)[:keep]
        starts = descent.begin(jnp.asarray(points))
        progress = SearchState(starts, np.ones(len(points), bool))
    try:
        while True:
            # Before the first iteration, the search has no result to judge, so Ctrl-C ends the process.
            with deferred(INTERRUPT_MESSAGE if progress.history else ""):
                raise_if_interrupted()
                before = progress.seconds
                if not progress.active.any() or progress.iteration - progress.since >= iterations:
                    if progress.phase + 1 == len(phases):
                        break
                    _begin_full_phase(engine, goal, members, progress, descent, given)
                phase = phases[progress.phase]
                iterate(engine, goal, members.part(phase.part, 1), progress, descent, seed=seed)
                _switch(progress, phase)
                progress.seconds = progress.earlier + time.perf_counter() - began
                checkpoint_file.save(progress)
                on_iteration(progress, progress.seconds - before)
            if time.perf_counter() > until:
                break
    except KeyboardInterrupt:
        progress.interrupted = True
    return progress


def _switch(progress: SearchState, phase: Phase) -> None:
    """Select the starts that continue, and those that switch to CMA-ES.

    A start ends if its step is at most SHORTEST. A descent also ends if its goal stalls, and CMA-ES if it has
    converged. The worse half ends after the iterations HALVINGS. A descent switches to CMA-ES at once if the norm of
    its gradient is STEEP or more. A descent that would end switches if the norm is `gradient_limit` or more. There are
    two causes of such a gradient: in a chaotic loop the derivatives grow with time and do not describe the goal; and a
    descent stops early at a jump of the goal, beyond which members are lost.
    """
    starts, count = progress.starts, progress.iteration - progress.since
    value, norm, active = np.asarray(starts.value), np.asarray(starts.gradient_norm), progress.active
    evolving = progress.evolving
    ended = np.asarray(starts.length) <= SHORTEST
    converged = np.array([progress.cma_state(at).converged for at in range(len(active))])
    # in the first phase, CMA-ES only helps to choose among the starts, and ends with the last halving
    chosen = phase.part > 1 and count >= HALVINGS[-1]
    ended |= np.where(evolving, converged | chosen, _stalled(progress, phase.patience, phase.stall))
    turns = active & ~evolving & ~((norm < STEEP) & ((norm < phase.gradient_limit) | ~ended))
    active = active & (~ended | turns)
    if count in HALVINGS:
        order = np.argsort(np.where(active, value, np.inf), kind="stable")
        active[order[max((int(active.sum()) + 1) // 2, 1) :]] = False
    for at in np.flatnonzero(turns & active):
        progress.set_cma_state(at, initial_state(np.asarray(starts.best)[at]))
    progress.active = active


def _stalled(progress: SearchState, patience: int, stall: float) -> np.ndarray:
    """Return whether the goal of each start [S] fell by less than `stall` over `patience` iterations of this phase."""
    if progress.iteration - progress.since <= patience:
        return np.zeros(len(progress.active), bool)
    past, value = progress.history["value"][-1 - patience], np.asarray(progress.starts.value)
    return np.isfinite(past) & (past - np.where(np.isfinite(value), value, 0.0) < stall)


def _begin_full_phase(
    engine: Engine,
    goal: Goal,
    members: Members,
    progress: SearchState,
    descent: Descent,
    given: np.ndarray,
) -> None:
    """Begin the phase on all members.

    It has one start: the best of `given` and of at most PATH_POINTS points that the first phase visited. The optimum of
    the first phase may lose members that the phase did not simulate; an earlier point is then better.
    """
    x, value = (np.array(progress.history[name][progress.since :]) for name in ("x", "value"))
    starts = value.shape[1]
    x, value = x.reshape(-1, x.shape[-1]), value.ravel()
    chosen = ranked(value, PATH_POINTS)
    tried = np.concatenate([x[chosen], given[None]])
    best = int(np.argsort(goal.score(tried, engine.terms(tried, members), members), kind="stable")[0])
    start = int(chosen[best] % starts) if best < len(chosen) else 0
    at = np.array(progress.starts.best)
    at[start] = tried[best]
    progress.starts = descent.restarted(jnp.asarray(at), progress.starts)
    progress.cma_states = idle_states(*at.shape)
    progress.active = np.arange(starts) == start
    progress.phase, progress.since = progress.phase + 1, progress.iteration


def ranked(value: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of at most `count` different values, the best first.

    The spacing of their ranks increases, so most of them are good ones.
    """
    _, first = np.unique(np.where(np.isfinite(value), value, np.inf), return_index=True)
    return first[np.unique((np.linspace(0, np.sqrt(len(first) - 1), count).round(6) ** 2).astype(int))]


def best_of(progress: SearchState) -> tuple[np.ndarray, float]:
    """Return the coordinates [m] and the goal of the best point of this phase."""
    value = np.asarray(progress.starts.value)
    at = int(np.argmin(value))
    return np.asarray(progress.starts.best)[at], float(value[at])
