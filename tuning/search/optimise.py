"""The search: a screen, then many starts refined at once; interrupted, resumed and repeated alike."""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.host.interrupts import gently, heed
from tuning.objective.engine import Engine
from tuning.objective.goal import Goal
from tuning.objective.loss import TERMS
from tuning.objective.members import Members
from tuning.optimisers import BFGS
from tuning.search.descent import Descent
from tuning.search.keeper import Keeper, Progress
from tuning.search.screen import screen

# A start has converged when its next step is shorter than this.
SHORTEST = 1e-3
# After these iterations of a phase the better half of the starts goes on.
HALVINGS = (4, 10)
# Points of the first phase's path that are tried on all members.
PATH = 12


class Phase(NamedTuple):
    """One ordinary member in `part` is asked, and all that are to be held: what loses them is a cliff.

    Finished when the goal fell by less than `stall` over `patience` iterations.
    """

    part: int
    stall: float
    patience: int


# On few members first: what they ask is nearly what all ask, at less than half of the cost.
FEW, ALL = Phase(4, 0.02, 3), Phase(1, 1e-3, 4)
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
    keeper: Keeper | None = None,
    resume: bool = False,
    tell: Callable[[Progress, float], None] = lambda search, seconds: None,
) -> Progress:
    """Refine the best `keep` of these points, coordinates [K, m]. Ctrl-C ends it early.

    Where there are more points than that, they are screened and refined on a part of the members first; the best point
    on the way there, the first of `points` included, goes on with all. At most `iterations` in each of these phases.
    `tell` is called after each iteration with the search and the seconds that it took.
    """
    descent = Descent(goal, name, rate)
    keeper = keeper or Keeper(None, {})
    phases = [FEW, ALL] if len(points) > keep else [ALL]
    given, began = points[0], time.perf_counter()
    progress = keeper.load(descent, min(keep, len(points)), points.shape[1]) if resume else None
    reserve: list[np.ndarray] = []  # [S, m] each, best first: where else this phase may begin
    if progress is not None:
        engine.rollouts = int(progress.history["rollouts"][-1])
    else:
        if len(points) > keep:
            points = screen(engine, who, points, keep, goal)
        reserve = [points[n : n + keep] for n in range(keep, len(points) - keep + 1, keep)]
        points = points[:keep]
        progress = Progress(descent.begin(jnp.asarray(points)), np.ones(len(points), bool))
    try:
        while True:
            # Before there is anything to judge, Ctrl-C ends the process as elsewhere.
            with gently(ENDING if progress.history else ""):
                heed()
                if not progress.active.any() or progress.iteration - progress.since >= iterations:
                    if progress.phase + 1 == len(phases):
                        break
                    reserve = _go_on_with_all(engine, goal, who, progress, descent, given)
                before = progress.seconds
                phase = phases[progress.phase]
                iterate(engine, goal, who.part(phase.part, 1), progress, descent)
                while reserve and not np.isfinite(np.asarray(progress.starts.value)[progress.active]).any():
                    _begin_elsewhere(progress, descent, reserve.pop(0))
                    iterate(engine, goal, who.part(phase.part, 1), progress, descent)
                reserve = []
                progress.active = _going_on(progress, phase)
                progress.seconds = progress.earlier + time.perf_counter() - began
                keeper.save(progress)
                tell(progress, progress.seconds - before)
    except KeyboardInterrupt:
        progress.interrupted = True
    return progress


def iterate(
    engine: Engine, goal: Goal, who: Members, progress: Progress, descent: Descent, weights: np.ndarray | None = None
) -> None:
    """One iteration of all active starts, which `progress` then holds. `weights` [S, 6]: each start has its own."""
    starts, active = progress.starts, np.flatnonzero(progress.active)
    trial = np.asarray(starts.trial)
    losses, slopes, terms = engine.gradient(trial[active], who, goal.weights if weights is None else weights[active])
    full = np.full((len(trial), *losses.shape[1:]), np.nan), np.full((len(trial), *slopes.shape[1:]), np.nan)
    for whole, part in zip(full, (losses, slopes), strict=True):
        whole[active] = part
    before = np.asarray(starts.value)
    starts = descent.step(who.ordinary, starts, *full, progress.active)
    value, past = np.asarray(starts.value), progress.history
    fresh = progress.iteration == progress.since
    lost = np.full(len(trial), len(who.member)) if fresh else np.array(past["lost"][-1])
    means = np.full((len(trial), len(TERMS)), np.nan) if fresh else np.array(past["terms"][-1])
    for row, at in enumerate(active):  # what is told of a start is told of its best point
        if value[at] < before[at]:
            lost[at] = int((terms["survival"][row] > 0).sum())
            means[at] = [terms[name][row][: who.ordinary].mean() for name in TERMS]
    row = {
        "value": value,
        "x": np.asarray(starts.best),
        "gains": np.asarray(jax.vmap(engine.objective.space.gains_at)(starts.best)),
        "lost": lost,
        "members": np.array(len(who.member)),
        "terms": means,
        "rollouts": np.array(engine.rollouts),
    }
    for key, value in row.items():
        past.setdefault(key, []).append(value)
    progress.starts, progress.iteration = starts, progress.iteration + 1


def _going_on(progress: Progress, phase: Phase) -> np.ndarray:
    """Which starts go on: not those whose steps have become tiny or whose loss stalls, nor the worse half in time."""
    value, length = np.asarray(progress.starts.value), np.asarray(progress.starts.length)
    active, count = progress.active & (length > SHORTEST), progress.iteration - progress.since
    if count in HALVINGS:
        order = np.argsort(np.where(active, value, np.inf), kind="stable")
        active[order[max((int(active.sum()) + 1) // 2, 1) :]] = False
    if count > phase.patience:
        past = progress.history["value"][-1 - phase.patience]
        active &= ~(np.isfinite(past) & (past - np.where(np.isfinite(past), value, 0.0) < phase.stall))
    return active


def _begin_elsewhere(progress: Progress, descent: Descent, at: np.ndarray) -> None:
    """Take the first iteration of a phase back and begin at `at` [S, m].

    Where a loop chatters, derivatives grow from sample to sample until they are no numbers, though the loss is one.
    """
    for rows in progress.history.values():
        rows.pop()
    progress.iteration -= 1
    progress.starts = descent.begin(jnp.asarray(at))


def _go_on_with_all(
    engine: Engine, goal: Goal, who: Members, progress: Progress, descent: Descent, given: np.ndarray
) -> list[np.ndarray]:
    """Begin the next phase from one point: that on the paths of all starts, or `given`, which is best for all members.

    The answer for a part of the members may lose others: then an earlier point is better, and on the right side of
    that cliff. Returns where else it may begin [S, m], best first.
    """
    x, value = (np.array(progress.history[name][progress.since :]) for name in ("x", "value"))
    starts = value.shape[1]
    x, value = x.reshape(-1, x.shape[-1]), value.ravel()
    _, first = np.unique(np.where(np.isfinite(value), value, np.inf), return_index=True)
    # the best ones, and fewer and fewer of the others
    chosen = first[np.unique((np.linspace(0, np.sqrt(len(first) - 1), PATH).round(6) ** 2).astype(int))]
    tried = np.concatenate([x[chosen], given[None]])
    best, *others = np.argsort(goal.score(tried, engine.terms(tried, who), who), kind="stable")
    start = chosen[best] % starts if best < len(chosen) else 0
    at = np.array(progress.starts.best)
    at[start] = tried[best]
    progress.starts = descent.anew(jnp.asarray(at), progress.starts)
    progress.active = np.arange(starts) == start
    progress.phase, progress.since = progress.phase + 1, progress.iteration
    return [np.repeat(tried[other][None], starts, axis=0) for other in others]


def best_of(progress: Progress) -> tuple[np.ndarray, float]:
    """Coordinates [m] and goal of the best point seen in this phase."""
    value = np.asarray(progress.starts.value)
    at = int(np.argmin(value))
    return np.asarray(progress.starts.best)[at], float(value[at])
