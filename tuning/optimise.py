"""The search: a screen, then many starts refined at once; interrupted, resumed and repeated alike."""

import dataclasses
import functools
import hashlib
import json
import os
import pathlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from tuning.conditions import Bound, shortfall
from tuning.loss import TERMS
from tuning.objective import Engine, Members, weigh
from tuning.optimisers import optimiser
from tuning.risk import Risk
from tuning.screen import screen

# A refused step is tried again at this share of its length; below the shortest, the start has converged.
SHORTER, SHORTEST = 0.25, 1e-3
# After these iterations the better half of the starts goes on.
HALVINGS = (4, 10)
# Finished when the loss fell by less than this over as many iterations.
STALL, PATIENCE = 2e-4, 6


class Starts(NamedTuple):
    """All starts: the point to try and the best so far [S, m], loss there [S], optimiser's state, step taken [S]."""

    trial: Array
    best: Array
    value: Array
    memory: Any
    length: Array
    refused: Array


@dataclasses.dataclass
class Search:
    """A search under way. `history` holds one row per iteration; everything else can be read off a checkpoint."""

    starts: Starts
    active: np.ndarray
    iteration: int
    history: dict[str, list[Any]]
    interrupted: bool = False


@dataclasses.dataclass(frozen=True)
class Goal:
    """What is minimised: the log of the risk of the weighted losses, plus the conditions' shortfall.

    Members after the `ordinary` first are stressed ones: their mean loss is added to the others' risk.
    """

    weights: tuple[float, ...]
    risk: Risk
    conditions: tuple[Bound, ...]
    weight: float
    margin: float

    def of(self, losses: Array, ordinary: int, shortfalls: Any) -> Array:
        """The goal from the losses [N] of the members."""
        risk = self.risk(losses[:ordinary])
        stressed = losses[ordinary:]
        return jnp.log(risk + (jnp.mean(stressed) if stressed.size else 0.0) + 1e-30) + self.weight * shortfalls

    def penalty(self, space: Any, x: Array) -> Array:
        """Shortfall of the theorem's conditions at x [m]."""
        return shortfall(dict(zip(space.paths, space.gains_at(x), strict=True)), self.conditions, self.margin)

    def score(self, space: Any, x: np.ndarray, terms: dict[str, np.ndarray], who: Members) -> np.ndarray:
        """The goal [S] from terms [S, N] of members [N]; +inf where it is not a number."""
        losses, ordinary = weigh(self.weights, terms, who.stressed), who.ordinary
        each = zip(losses, x, strict=True)
        values = np.array(
            [self.of(jnp.asarray(one), ordinary, self.penalty(space, jnp.asarray(at))) for one, at in each]
        )
        return np.where(np.isfinite(values), values, np.inf)


def stepper(engine: Engine, goal: Goal, name: str, rate: float) -> tuple[Callable[..., Starts], Callable[..., Starts]]:
    """(begin, step): starts at coordinates [S, m], and what the losses and derivatives at their trials make of them.

    step(ordinary, starts, losses [S, N], slopes [S, N, m], on [S]); `ordinary` of the members are not stressed.
    """
    space, method = engine.objective.space, optimiser(name, rate)
    monotone = name == "bfgs"

    @jax.jit
    def begin(x: Array) -> Starts:
        never = jnp.full(x.shape[0], jnp.inf, x.dtype)
        return Starts(x, x, never, jax.vmap(method.init)(x), never, jnp.zeros(x.shape[0], int))

    def one(ordinary: int, start: Starts, losses: Array, slopes: Array, on: Array) -> Starts:
        value, weights = jax.value_and_grad(goal.of)(losses, ordinary, 0.0)
        extra, slope = jax.value_and_grad(lambda x: goal.weight * goal.penalty(space, x))(start.trial)
        value, gradient = value + extra, weights @ slopes + slope
        finite = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        better = finite & (value < start.value)
        accept = on & (better if monotone else finite)
        shown = jnp.where(finite, gradient, 0.0)
        step: Any
        step, memory = method.update(shown, start.memory, start.trial)
        anew = start.trial + step
        back = start.best + SHORTER * (start.trial - start.best)
        pick = lambda a, b: jax.tree.map(lambda p, q: jnp.where(accept, p, q), a, b)  # noqa: E731
        fresh = Starts(
            pick(anew, back),
            jnp.where(better, start.trial, start.best),
            jnp.where(better, value, start.value),
            pick(memory, start.memory),
            jnp.linalg.norm(pick(step, back - start.best)),
            jnp.where(accept, 0, start.refused + 1),
        )
        return jax.tree.map(lambda p, q: jnp.where(on, p, q), fresh, start)

    @functools.partial(jax.jit, static_argnums=0)
    def step(ordinary: int, starts: Starts, losses: Array, slopes: Array, on: Array) -> Starts:
        return jax.vmap(functools.partial(one, ordinary))(starts, losses, slopes, on)

    return begin, step


class Keeper:
    """The checkpoint of a search: written whole, then renamed, so that there is always a good one."""

    def __init__(self, path: pathlib.Path | None, told: Any):
        self.path = path
        self.fingerprint = hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()

    def save(self, search: Search) -> None:
        if self.path is None:
            return
        leaves = {f"leaf_{n}": np.asarray(leaf) for n, leaf in enumerate(jax.tree.leaves(search.starts))}
        past = {f"history_{name}": np.asarray(rows) for name, rows in search.history.items()}
        partial = self.path.with_suffix(".partial.npz")
        state = {"active": search.active, "iteration": search.iteration, "fingerprint": self.fingerprint}
        np.savez(partial, **leaves, **past, **state)  # pyright: ignore[reportArgumentType]
        os.replace(partial, self.path)  # noqa: PTH105

    def load(self, begin: Callable[..., Starts], m: int) -> Search | None:
        """The search so far, or None. Raises ValueError if it belongs to another study."""
        if self.path is None or not self.path.exists():
            return None
        with np.load(self.path) as kept:
            if str(kept["fingerprint"]) != self.fingerprint:
                raise ValueError(
                    f"--resume: {self.path} belongs to a search with another case or other settings. "
                    "Use another --out, or leave out --resume to begin anew."
                )
            tree = jax.tree.structure(jax.eval_shape(begin, jnp.zeros((1, m))))
            count = sum(name.startswith("leaf_") for name in kept.files)
            starts = jax.tree.unflatten(tree, [jnp.asarray(kept[f"leaf_{n}"]) for n in range(count)])
            history = {n.removeprefix("history_"): list(kept[n]) for n in kept.files if n.startswith("history_")}
            return Search(starts, kept["active"], int(kept["iteration"]), history)


def search(
    engine: Engine,
    goal: Goal,
    who: Members,
    points: np.ndarray,
    *,
    keep: int = 1,
    iterations: int,
    name: str = "bfgs",
    rate: float = 0.1,
    keeper: Keeper | None = None,
    resume: bool = False,
    tell: Callable[[Search, float], None] = lambda search, seconds: None,
) -> Search:
    """Refine the best `keep` of these points, coordinates [K, m]. Ctrl-C ends it early.

    `tell` is called after each iteration with the search and the seconds that it took.
    """
    space = engine.objective.space
    begin, step = stepper(engine, goal, name, rate)
    keeper = keeper or Keeper(None, None)
    kept = keeper.load(begin, len(space)) if resume else None
    if kept is not None:
        engine.rollouts = int(kept.history["rollouts"][-1])
    else:
        if len(points) > keep:
            points = screen(engine, who, points, keep, lambda x, terms, some: goal.score(space, x, terms, some))
        kept = Search(begin(jnp.asarray(points)), np.ones(len(points), bool), 0, {})
    try:
        while kept.iteration < iterations and kept.active.any():
            began = time.perf_counter()
            iterate(engine, goal, who, kept, step)
            keeper.save(kept)
            tell(kept, time.perf_counter() - began)
    except KeyboardInterrupt:
        kept.interrupted = True
    return kept


def iterate(
    engine: Engine, goal: Goal, who: Members, kept: Search, step: Callable[..., Starts], weights: Any = None
) -> None:
    """One iteration of all active starts, written into `kept`.

    `weights` [S, 6]: each start has a goal of its own, and all go on.
    """
    starts, active = kept.starts, np.flatnonzero(kept.active)
    trial = np.asarray(starts.trial)
    losses, slopes, terms = engine.gradient(trial[active], who, goal.weights if weights is None else weights[active])
    full = np.full((len(trial), *losses.shape[1:]), np.nan), np.full((len(trial), *slopes.shape[1:]), np.nan)
    for whole, part in zip(full, (losses, slopes), strict=True):
        whole[active] = part
    before = np.asarray(starts.value)
    starts = step(who.ordinary, starts, *full, kept.active)
    value = np.asarray(starts.value)
    past = kept.history
    lost = np.array(past["lost"][-1]) if past else np.full(len(trial), len(who.member))
    means = np.array(past["terms"][-1]) if past else np.full((len(trial), len(TERMS)), np.nan)
    for row, at in enumerate(active):  # what is told of a start is told of its best point
        if value[at] < before[at]:
            lost[at] = int((terms["survival"][row] > 0).sum())
            means[at] = [terms[name][row][: who.ordinary].mean() for name in TERMS]
    row = {
        "value": value,
        "gains": np.asarray(jax.vmap(engine.objective.space.gains_at)(starts.best)),
        "lost": lost,
        "terms": means,
        "rollouts": np.array(engine.rollouts),
    }
    for key, value in row.items():
        kept.history.setdefault(key, []).append(value)
    kept.starts, kept.iteration = starts, kept.iteration + 1
    kept.active = _going_on(kept, halving=weights is None)


def _going_on(kept: Search, halving: bool) -> np.ndarray:
    """Which starts go on: not those whose steps have become tiny or whose loss stalls, nor the worse half in time."""
    value, length = np.asarray(kept.starts.value), np.asarray(kept.starts.length)
    active = kept.active & (length > SHORTEST)
    if halving and kept.iteration in HALVINGS:
        order = np.argsort(np.where(active, value, np.inf), kind="stable")
        worse = order[max((int(active.sum()) + 1) // 2, 1) :]
        active[worse] = False
    if kept.iteration > PATIENCE:
        past = kept.history["value"][-1 - PATIENCE]
        active &= ~(np.isfinite(past) & (past - np.where(np.isfinite(past), value, 0.0) < STALL))
    return active


def best_of(kept: Search) -> tuple[np.ndarray, float]:
    """Coordinates [m] and goal of the best point seen."""
    value = np.asarray(kept.starts.value)
    at = int(np.argmin(value))
    return np.asarray(kept.starts.best)[at], float(value[at])
