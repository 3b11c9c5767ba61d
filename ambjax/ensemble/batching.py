"""The engine: many members at once, in blocks that fit the first-level cache, on every core or device.

Whatever is asked of a member, its result depends on nothing else: not on who runs beside it, in which block,
thread, device or order.
"""

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ambjax.compiler.fast_path import block_bytes, one_kernel
from ambjax.control.cascade import Cascade
from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import Fold
from ambjax.simulation.rollout import Outcome, System, prepare, run
from ambjax.world.scenario import Scenario

MOST_CALL = 4096
MEMBERS = "members"


class Parts(NamedTuple):
    """A pytree split into the leaves that differ between members, [N] each, and those that all share."""

    moving: Any
    shared: Any


def run_ensemble(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    *,
    fold: Fold | None,
    every: int = 0,
    threads: int | None = None,
    call: int | None = None,
) -> Outcome:
    """Simulate every member of an ensemble; results in member order, every leaf with a leading axis [N].

    Leaves of `cascade`, `scenario` and `fold` are numbers, shared by all members, or arrays [N], one entry for
    each; at least one must be an array (`scenario.member`, for one). A member is told by that; so is its noise.
    `fold` sees every sample; rows are recorded at every `every`-th sample (0: none), [N, rows]. `threads` and `call`
    as in `map_members`.

    Raises ValueError as `rollout` does, and where the lengths of two leaves differ.
    """
    tree = canonical((*prepare(cascade, scenario, clock), fold))
    return map_members(_rollout(every), tree, threads=threads, call=call)


@functools.cache
def _rollout(every: int) -> Callable[[Any], Outcome]:
    """The rollout of one member; the same function each time, so that it compiles once."""

    def one(tree: tuple[System, Clock, Fold | None]) -> Outcome:
        system, clock, fold = tree
        return run(system, clock, fold, every)

    return one


def map_members(
    function: Callable[[Any], Any],
    tree: Any,
    *,
    threads: int | None = None,
    call: int | None = None,
    block: int | None = None,
    plain: bool = False,
) -> Any:
    """function(member) of every member of an ensemble; results in member order, every leaf with a leading axis [N].

    Leaves of `tree` are numbers, shared by all members, or arrays [N, ...], one entry for each; at least one must be
    an array. `function`, of a tree whose leaves are those of one member, is traced by JAX, and is compiled again for
    one that is not equal (==): give it a name, or make it a frozen dataclass. Members run on all devices that
    there are, on a CPU on `threads` cores (None: all that this process may use). One call of the compiled program
    takes `call` members, in whole blocks (None: equal shares for all cores, 4096 at most; of fewer blocks than cores,
    some cores get none): memory grows with that, not with N, and another number compiles again. `block` of them run
    together, in vectors (None: as many as fit the first-level cache). `plain`: without the fast path, which knows no
    reverse mode. Results are NumPy arrays.

    Raises ValueError where the lengths of two leaves differ, or there is none.
    """
    return _Engine(function, tree, threads, call, block, plain).results()


def size(tree: Any) -> int:
    """Number of members: the common length of all array leaves.

    Raises ValueError if there is none, or if they differ.
    """
    lengths = {np.shape(x)[0] for x in jax.tree.leaves(tree) if np.ndim(x)}
    if len(lengths) != 1:
        listing = " and ".join(str(n) for n in sorted(lengths)) or "none"
        raise ValueError(
            f"ensemble: leaves have lengths {listing}; there must be one length. Give scenario.member = np.arange(N), "
            "and every other leaf that varies as an array of the same N."
        )
    return lengths.pop()


class _Engine:
    """One ensemble, cut into calls of equal shape, so that it compiles once."""

    def __init__(self, function: Callable[[Any], Any], tree: Any, threads: Any, call: Any, block: Any, plain: bool):
        leaves, self.tree = jax.tree.flatten(tree)
        self.members, self.moves = size(tree), tuple(bool(np.ndim(x)) for x in leaves)
        self.moving = [np.asarray(x) for x in leaves if np.ndim(x)]
        self.shared = tuple(x for x in leaves if not np.ndim(x))
        self.function, self.devices = function, jax.devices()
        alone = len(self.devices) == 1 and self.devices[0].platform == "cpu"
        self.workers = (threads or cores()) if alone else 1
        # equal calls: the last one is as long as the others, whatever is left for it
        calls = max(-(-self.members // (MOST_CALL * self.workers)), 1) * self.workers
        share = call or -(-self.members // calls)
        self.block = block or block_bytes(share) // jnp.result_type(float).itemsize
        unit = self.block * len(self.devices)
        self.call = -(-share // unit) * unit
        self.program = _program(len(self.devices), plain)

    def results(self) -> Any:
        """Run all calls and put the results in order."""
        starts = range(0, self.members, self.call)
        with ThreadPoolExecutor(min(self.workers, len(starts))) as pool:
            parts = list(pool.map(self._one, starts))
        whole = jax.tree.map(lambda *xs: np.concatenate(xs), *parts)
        return jax.tree.map(lambda x: x[: self.members], whole)

    def _one(self, start: int) -> Any:
        """One call: members from `start` on, the last one repeated where the call is longer than what is left."""
        index = np.minimum(np.arange(start, start + self.call), self.members - 1)
        parts = Parts(tuple(x[index] for x in self.moving), self.shared)
        results = self.program(parts, function=self.function, moves=self.moves, tree=self.tree, block=self.block)
        return jax.tree.map(np.asarray, results)


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _blocks(parts: Parts, *, function: Callable[[Any], Any], moves: tuple[bool, ...], tree: Any, block: int) -> Any:
    """All members of a call: a loop over blocks, the whole function of a block inside it."""

    def member(moving: tuple[Array, ...]) -> Any:
        own, common = iter(moving), iter(parts.shared)
        return function(jax.tree.unflatten(tree, [next(own) if its else next(common) for its in moves]))

    if jax.default_backend() != "cpu":
        return jax.vmap(member)(parts.moving)
    cut = jax.tree.map(lambda x: x.reshape(-1, block, *x.shape[1:]), parts.moving)
    results = lax.map(jax.vmap(member), cut)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), results)


STATIC = ("function", "moves", "tree", "block")
_fast = one_kernel(_blocks, static_argnames=STATIC)
_usual = jax.jit(_blocks, static_argnames=STATIC)


@functools.cache
def _program(devices: int, plain: bool) -> Callable[..., Any]:
    """The compiled program: for one device, or with members sharded over several."""
    if devices == 1:
        return _usual if plain else _fast
    mesh = Mesh(np.asarray(jax.devices()[:devices]), (MEMBERS,))
    over, everywhere = PartitionSpec(MEMBERS), PartitionSpec()

    def spread(parts: Parts, **static: Any) -> Any:
        one = functools.partial(_blocks, **static)
        # Members do not speak to each other: nothing to check, and constants may stay unsharded.
        where = {"mesh": mesh, "in_specs": (Parts(over, everywhere),), "out_specs": over, "check_vma": False}
        return jax.shard_map(one, **where)(parts)

    compiled = jax.jit if plain else one_kernel
    kernel = compiled(spread, static_argnames=STATIC)

    def placed(parts: Parts, **static: Any) -> Any:
        moving = jax.device_put(parts.moving, NamedSharding(mesh, over))
        return kernel(Parts(moving, jax.device_put(parts.shared, NamedSharding(mesh, everywhere))), **static)

    return placed
