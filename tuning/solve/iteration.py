"""One iteration of a search: one descent step, or one CMA-ES population, of each start.

A start is a point that the search refines, with the state of its optimiser.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from tuning.events import Reached, Standing
from tuning.problem.goal import Goal
from tuning.problem.lanes import Engine
from tuning.problem.limits import PREFIX
from tuning.problem.loss import TERMS
from tuning.problem.members import Members
from tuning.problem.quantities import KINDS
from tuning.problem.tuning_problem import TuningProblem
from tuning.solve.checkpoint import SearchState
from tuning.solve.descent import Descent
from tuning.solve.evolution import next_population, updated


def iterate(
    engine: Engine,
    goal: Goal,
    members: Members,
    progress: SearchState,
    descent: Descent,
    weights: np.ndarray | None = None,
    seed: int = 0,
) -> None:
    """Run one iteration of all active starts and update `progress`.

    `weights` [S, 6]: weights of the loss terms for the descent of each start; None: those of the goal. `seed`: seed of
    the populations of CMA-ES.
    """
    fresh = progress.iteration == progress.since
    better = _descended(engine, goal, members, progress, descent, weights) | _evolved(
        engine, goal, members, progress, seed
    )
    _append_history(engine, goal, members, progress, better, fresh=fresh)


def _descended(
    engine: Engine,
    goal: Goal,
    members: Members,
    progress: SearchState,
    descent: Descent,
    weights: np.ndarray | None,
) -> dict[int, dict[str, np.ndarray]]:
    """Run one step of each start that descends. Return the loss terms of the starts that improve, by index and name."""
    starts, on = progress.starts, progress.active & ~progress.evolving
    active = np.flatnonzero(on)
    if not active.size:
        return {}
    trial = np.asarray(starts.trial)
    losses, slopes, terms = engine.gradient(
        trial[active], members, goal.weights if weights is None else weights[active]
    )
    full = np.full((len(trial), *losses.shape[1:]), np.nan), np.full((len(trial), *slopes.shape[1:]), np.nan)
    for whole, part in zip(full, (losses, slopes), strict=True):
        whole[active] = part
    progress.starts = descent.step(members.ordinary, starts, *full, on)
    better = np.flatnonzero((np.asarray(progress.starts.value) < np.asarray(starts.value))[active])
    return {int(active[row]): {name: one[row] for name, one in terms.items()} for row in better}


def _evolved(
    engine: Engine, goal: Goal, members: Members, progress: SearchState, seed: int
) -> dict[int, dict[str, np.ndarray]]:
    """Evaluate one population of each start that uses CMA-ES and update its distribution. Returns as `_descended`."""
    active = np.flatnonzero(progress.active & progress.evolving)
    if not active.size:
        return {}
    own = [progress.cma_state(at) for at in active]
    points = [next_population(cma, seed + int(at)) for cma, at in zip(own, active, strict=True)]
    terms = engine.terms(np.concatenate(points), members)
    values = goal.score(np.concatenate(points), terms, members).reshape(len(points), -1)
    best, value, length = (np.array(x) for x in (progress.starts.best, progress.starts.value, progress.starts.length))
    better = {}
    for row, at in enumerate(active):
        first = int(np.argmin(values[row]))
        if values[row, first] < value[at]:
            best[at], value[at] = points[row][first], values[row, first]
            better[int(at)] = {name: one[row * len(values[row]) + first] for name, one in terms.items()}
        cma = updated(own[row], points[row], values[row])
        length[at] = cma.reach
        progress.set_cma_state(at, cma)
    state = progress.starts.state._replace(best=jnp.asarray(best), value=jnp.asarray(value))
    progress.starts = progress.starts._replace(state=state, length=jnp.asarray(length))
    return better


def _append_history(
    engine: Engine,
    goal: Goal,
    members: Members,
    progress: SearchState,
    better: dict[int, dict[str, np.ndarray]],
    *,
    fresh: bool = False,
) -> None:
    """Add a row with the best point of each start to the history, and increment `progress.iteration`.

    `better`: loss terms and limited quantities [N] by name, by index of each start that improved. `fresh`: whether this
    is the first row of a phase; an earlier row then belongs to other members.
    """
    past, count, n = progress.history, len(progress.active), members.ordinary
    lost = np.full(count, len(members.member)) if fresh else np.array(past["lost"][-1])
    means = np.full((count, len(TERMS)), np.nan) if fresh else np.array(past["terms"][-1])
    quantities = np.full((count, len(goal.quantities)), np.nan) if fresh else np.array(past["quantities"][-1])
    for at, terms in better.items():
        lost[at] = int((terms["survival"] > 0).sum())
        means[at] = [terms[name][:n].mean() for name in TERMS]
        quantities[at] = [float(KINDS[name].tuned(jnp.asarray(terms[PREFIX + name][:n]))) for name in goal.quantities]
    row = {
        "value": np.asarray(progress.starts.value),
        "x": np.asarray(progress.starts.best),
        "gains": np.asarray(jax.vmap(engine.objective.space.gains_at)(progress.starts.best)),
        "lost": lost,
        "members": np.array(len(members.member)),
        "terms": means,
        "quantities": quantities,
        "rollouts": np.array(engine.rollouts),
    }
    for key, value in row.items():
        past.setdefault(key, []).append(value)
    progress.iteration += 1


def standing_of(problem: TuningProblem, progress: SearchState, number: int, spent: Sequence[float]) -> Standing:
    """Return the standing of a search. `spent`: durations of its iterations so far, s."""
    last = {name: rows[-1] for name, rows in progress.history.items()}
    best, loss, budget = int(np.argmin(last["value"])), problem.objective.loss, problem.tune.budget
    terms = dict(zip(TERMS, last["terms"][best], strict=True))
    quantities = dict(zip(problem.goal.quantities, last["quantities"][best], strict=True))
    volts = quantities.get("rms_u_V", float(np.asarray(loss.u_scale)) * math.sqrt(terms["effort"]))
    values = [(one, one.ratio * float(quantities[one.name])) for one in problem.limits]
    limits = tuple(Reached(one.name, value, one.threshold, one.holds(value)) for one, value in values)
    done, going = progress.iteration - progress.since, int(progress.active.sum())
    # the first iteration compiles
    each = float(np.median(spent[1:])) if len(spent) > 1 else math.nan
    return Standing(
        number, done, budget.iterations, going, float(np.asarray(loss.s_0)) * math.sqrt(terms["tracking"]), volts,
        int(last["members"] - last["lost"][best]), int(last["members"]), limits,
        (budget.iterations - done) * each * going / len(progress.active), float(last["value"][best]),
        int(last["rollouts"]),
    )  # fmt: skip
