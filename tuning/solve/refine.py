"""The search: a screen, a race of its best points on few members, then descent or CMA-ES of the winner on all of them.

A search can be interrupted and resumed.
"""

import math
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from ambjax.host.interrupts import deferred, raise_if_interrupted
from tuning.problem.goal import Goal
from tuning.problem.lanes import Engine
from tuning.problem.limits import PREFIX
from tuning.problem.loss import TERMS
from tuning.problem.members import FEW, Members
from tuning.problem.quantities import KINDS
from tuning.solve.checkpoint import CheckpointFile, SearchState
from tuning.solve.descent import Descent, Starts, begin, continued
from tuning.solve.evolution import PATIENCE, Evolution

# The starts race on a pair of members, at most 2 FEW of them on a part. After each PATIENCE iterations the better half
# continues. The last FEW are compared on all members, and the best of them continues alone.
# A search has converged if its next step, in coordinates, is shorter than SHORTEST: 0.1 % of a gain. It ends also if
# the goal, a logarithm, falls by less than this over PATIENCE iterations.
SHORTEST = 1e-3
# At the end of a descent, the norm of the gradient distinguishes converged descents from those that stop early. In
# benchmarks/tasks, the former have norms of 0.001 to 0.02, the latter of 0.36 to 1e127. The norm is the change of the
# goal per factor e of a gain.
CONVERGED = 0.1
# Message at the first Ctrl-C.
INTERRUPT_MESSAGE = "the search ends after this iteration; its best gains are then judged and written."


def search(
    engine: Engine,
    goal: Goal,
    members: Members,
    points: np.ndarray,
    *,
    keep: int = 1,
    earlier: Starts | None = None,
    evolve: bool = True,
    iterations: int,
    seed: int = 0,
    checkpoint_file: CheckpointFile | None = None,
    resume: bool = False,
    until: float = math.inf,
    on_iteration: Callable[[SearchState, float], None] = lambda search, seconds: None,
) -> SearchState:
    """Refine the best `keep` of these points, coordinates [K, m], which a screen selects. Ctrl-C ends the search early.

    The starts descend (`Descent`) in a race on a few of the members (`_race`), the winner on all members. If its
    gradient does not lead to a minimum, it continues with CMA-ES. The search ends after `iterations` of the winner.

    `earlier`: starts of an earlier search, with whose inverse Hessian the one start of this search begins. `evolve`:
    whether CMA-ES continues a descent that ends early; it always does if its gradient is steep.
    `seed`: seed of the populations of CMA-ES. `on_iteration`: called after each iteration with the search and the
    duration of the iteration in s. `until`: time of `time.perf_counter` after which the search ends at its next
    iteration.
    """
    descent, began = Descent(goal), time.perf_counter()
    checkpoint_file = checkpoint_file or CheckpointFile(None, {})
    progress = checkpoint_file.load() if resume else None
    if progress is not None:
        engine.rollouts = int(progress.history["rollouts"][-1])
    else:
        if len(points) > keep:
            points = screen(engine, members, points, goal)[0][:keep]
        starts = begin(jnp.asarray(points)) if earlier is None else continued(earlier, jnp.asarray(points))
        progress = SearchState(starts, raced=race_length(len(points)))
    try:
        while not progress.converged and progress.iteration < progress.raced + iterations:
            # Before the first iteration, the search has no result to judge, so Ctrl-C ends the process.
            with deferred(INTERRUPT_MESSAGE if progress.history else ""):
                raise_if_interrupted()
                before = progress.seconds
                iterate(engine, goal, _heat(members, progress.starts), progress, descent)
                if progress.racing:
                    _race(engine, goal, members, progress)
                else:
                    _advance(progress, seed, evolve)
                progress.seconds = progress.earlier + time.perf_counter() - began
                checkpoint_file.save(progress)
                on_iteration(progress, progress.seconds - before)
            if time.perf_counter() > until:
                break
    except KeyboardInterrupt:
        progress.interrupted = True
    return progress


def race_length(starts: int) -> int:
    """Return the number of iterations of a race of this many starts."""
    halvings = math.ceil(math.log2(max(starts / FEW, 1)))
    return PATIENCE * (halvings + 1) if starts > 1 else 0


def screen(engine: Engine, members: Members, x: np.ndarray, goal: Goal) -> tuple[np.ndarray, np.ndarray]:
    """Return the best of the points x [K, m] and their goals on a part of the members, the best first.

    Of many points, the part evaluates only the first one and those that are best on a pair of members.
    """
    some = members.part
    if len(x) > FEW**2:
        goals = goal.score(engine.terms(x, members.pair), members.pair)
        best = np.argsort(goals, kind="stable")[: max(len(x) // FEW, FEW**2)]
        x = x[np.union1d(best, 0)]
    goals = goal.score(engine.terms(x, some), some)
    order = np.argsort(goals, kind="stable")
    return x[order], goals[order]


def iterate(engine: Engine, goal: Goal, members: Members, progress: SearchState, descent: Descent) -> None:
    """Make one step of each start, or draw one population of CMA-ES, and add the best point to the history."""
    if progress.evolution is not None:
        x, value, terms = _evolved(engine, goal, members, progress.evolution)
    else:
        x, value, terms = _descended(engine, goal, members, progress, descent)
    past, n = progress.history, members.ordinary
    if past and int(past["members"][-1]) == len(members.member) and not value < past["value"][-1]:
        row = {name: past[name][-1] for name in ("value", "x", "gains", "lost", "terms", "quantities")}
    else:
        tuned = [float(KINDS[name].tuned(jnp.asarray(terms[PREFIX + name][:n]))) for name in goal.quantities]
        row = {
            "value": np.array(value),
            "x": x,
            "gains": np.asarray(engine.objective.space.gains_at(jnp.asarray(x))),
            "lost": np.array(int((terms["survival"] > 0).sum())),
            "terms": np.array([terms[name][:n].mean() for name in TERMS]),
            "quantities": np.array(tuned),
        }
    row |= {"members": np.array(len(members.member)), "rollouts": np.array(engine.rollouts)}
    for key, one in row.items():
        past.setdefault(key, []).append(one)


def _descended(
    engine: Engine, goal: Goal, members: Members, progress: SearchState, descent: Descent
) -> tuple[np.ndarray, float, dict[str, Any]]:
    """Make one step of each start. Return the best point so far [m], its goal, and the terms [N] at its trial.

    If the best point is older than this step, the terms are those of the last trial of its start.
    """
    losses, slopes, terms = engine.gradient(np.asarray(progress.starts.trial), members, goal.weights)
    starts = progress.starts = descent(members.ordinary, progress.starts, losses, slopes)
    best = int(np.argmin(starts.value))
    return np.asarray(starts.best)[best], float(starts.value[best]), {name: one[best] for name, one in terms.items()}


def _evolved(
    engine: Engine, goal: Goal, members: Members, evolution: Evolution
) -> tuple[np.ndarray, float, dict[str, Any]]:
    """Draw one population and update the distribution. Return the best of its points [m], its goal and terms [N]."""
    points = evolution.ask()
    terms = engine.terms(points, members)
    values = goal.score(terms, members)
    evolution.tell(points, values)
    first = int(np.argmin(values))
    return points[first], float(values[first]), {name: one[first] for name, one in terms.items()}


def _race(engine: Engine, goal: Goal, members: Members, progress: SearchState) -> None:
    """After each PATIENCE iterations, or if no gradient leads to a minimum, select the starts that continue.

    On other members, a start begins again at its best point, with its inverse Hessian.
    """
    starts, keep = progress.starts, (len(progress.starts.value) + 1) // 2
    if progress.iteration % PATIENCE and not _steep(starts).all():
        return
    values = np.asarray(starts.value)
    if len(values) <= FEW:
        values, keep = goal.score(engine.terms(np.asarray(starts.best), members), members), 1
    best = np.argsort(values, kind="stable")[:keep]
    progress.starts = Starts(*(leaf[best] for leaf in starts))
    progress.raced = progress.raced if progress.racing else progress.iteration
    if len(_heat(members, progress.starts).member) != len(_heat(members, starts).member):
        progress.starts = progress.starts._replace(trial=progress.starts.best, value=jnp.full(keep, jnp.inf))


def _heat(members: Members, starts: Starts) -> Members:
    """Return the members on which the starts race, or all for one start."""
    count = len(starts.value)
    return members if count == 1 else members.part if count <= 2 * FEW else members.pair


def _advance(progress: SearchState, seed: int, evolve: bool) -> None:
    """End the search, or let it switch to CMA-ES.

    A descent ends if its step is at most SHORTEST, or if the goal stalls. If `evolve`, it switches if it has then ended
    `early`. It always switches at once if its gradient is steep: if it predicts a change of the goal by 1 within a step
    of SHORTEST. There are two causes of such gradients: in a chaotic loop the derivatives grow with time and do not
    describe the goal; and a descent stops early at a jump of the goal, beyond which members are lost.
    """
    if progress.evolution is not None:
        progress.converged = progress.evolution.reach <= SHORTEST or progress.evolution.converged
        return
    starts, values = progress.starts, progress.history["value"][progress.raced :]
    stalled = len(values) > PATIENCE and values[-1] > values[-1 - PATIENCE] - SHORTEST
    ended = stalled or float(jnp.linalg.norm(starts.trial - starts.best)) <= SHORTEST
    progress.converged = ended
    if _steep(starts)[0] or (evolve and early(progress)):
        progress.evolution, progress.converged = Evolution(progress.history["x"][-1], seed), False


def early(progress: SearchState) -> bool:
    """Return whether a descent has ended with a gradient of CONVERGED or more, and CMA-ES has not continued it."""
    return progress.converged and progress.evolution is None and not _slopes(progress.starts)[0] < CONVERGED


def _steep(starts: Starts) -> np.ndarray:
    """Return whether each gradient predicts a change of the goal by 1 within a step of SHORTEST [S]."""
    return ~(SHORTEST * _slopes(starts) < 1)


def _slopes(starts: Starts) -> np.ndarray:
    """Return the norm of each gradient [S], without overflow of its squares; inf before the first trial."""
    return np.where(np.isfinite(starts.value), np.hypot.reduce(np.asarray(starts.gradient), axis=1), math.inf)


def best_of(progress: SearchState) -> tuple[np.ndarray, float]:
    """Return the coordinates [m] and the goal of the best point."""
    return progress.history["x"][-1], float(progress.history["value"][-1])
