"""The ensemble engine: run many members at once, in blocks that fit the first-level cache, on all cores or devices.

On a CPU, the result of a member does not depend on the other members, nor on its block, thread or position in the
order. On a GPU it may, because the compiled program depends on the number of members in a call.
"""

import dataclasses
import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ambjax.compiler.fast_path import block_length, one_kernel
from ambjax.control.cascade import Cascade
from ambjax.numerics.declared import require_number
from ambjax.numerics.records import canonical, require_concrete
from ambjax.numerics.shapes import varying
from ambjax.simulation.clock import Clock, takes_case
from ambjax.simulation.folds import Fold
from ambjax.simulation.rollout import Result, RolloutState, System, begin, finish, prepare, segment
from ambjax.simulation.system import check_recording
from ambjax.world.scenario import Scenario

# Largest number of members in one call of the compiled program, if the argument `call` is None.
MOST_CALL = 4096
# If an ensemble is split into several calls, each call has at least so many members that an array with one number per
# member has this size (bytes). Two smaller calls on two cores are not faster than one call on one core.
LEAST_BYTES = 256
# Name of the mesh axis over which members are distributed.
MEMBERS = "members"

# What the mapped function returns: a pytree, of one member, of a block or of the whole ensemble.
Mapped = TypeVar("Mapped")


class Parts(NamedTuple):
    """A pytree split into the leaves that vary between members, each [N, ...], and the leaves common to all members."""

    moving: Any
    shared: Any


@takes_case
def run_ensemble(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    *,
    fold: Fold | None,
    record_every: int = 0,
    threads: int | None = None,
    call: int | None = None,
) -> Result:
    """Simulate every member of an ensemble.

    A leaf of `cascade`, `scenario` and `fold` that has the shape its field declares (a number, if none is declared) is
    shared by all members. With one axis more, [N, ...], it has one entry per member. At least one leaf must have this
    axis, for example `scenario.member`, which selects the noise of a member.
    `fold` is updated at every sample; None: no metrics. Rows are recorded at every `record_every`-th sample (0: none).
    `threads` and `call` are those of `map_members`.

    Returns a Result in member order: every leaf has a leading axis [N], rows have shape [N, rows].

    Raises ValueError as `rollout` does, if the lengths of two leaves differ, and if no leaf is an array.
    """
    check_recording(fold, record_every)
    tree = canonical((*prepare(cascade, scenario, clock), fold))
    return map_members(Rollouts(record_every), tree, threads=threads, call=call, vectorised=True)


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """The function that simulates a block of members, for `map_members` with `vectorised`."""

    record_every: int = 0

    def __call__(self, tree: tuple[System, Clock, Fold | None], axes: Any) -> Result:
        # The state has an axis of members from the first sample on. Otherwise JAX maps a sample again and again, until
        # it knows which parts of the state vary. A fold may have parts that do not, such as the number of the sample.
        start = jax.vmap(functools.partial(begin, fold=None), axes[:2], axis_size=size(tree))(*tree[:2])

        def rest(system: System, clock: Clock, fold: Fold | None, start: RolloutState) -> Result:
            progress = start if fold is None else start._replace(fold=fold.init())
            progress, rows = segment(system, clock, fold, progress, 0, clock.samples, self.record_every)
            return finish(progress, rows, fold)

        return jax.vmap(rest, (*axes, 0))(*tree, start)


def map_members(
    function: Callable[..., Mapped],
    tree: object,
    *,
    threads: int | None = None,
    call: int | None = None,
    block: int | None = None,
    compiled: Callable[..., Callable] = one_kernel,
    vectorised: bool = False,
) -> Mapped:
    """Return function(member) for every member of an ensemble.

    A leaf of `tree` is shared by all members, or an array [N, ...] with one entry per member. In a record, it has this
    first axis if it has one axis more than its field declares; elsewhere, if it is an array. At least one leaf must
    have it. Members run on all devices of the default backend.

    - `function`: maps a tree with the leaves of one member to a pytree of arrays. JAX traces it, and compiles it again
      unless an equal (==) function was mapped before. Use a named function or a frozen dataclass, not a new lambda.
    - `threads`: CPU cores to use (None: all cores that this process may use). It has no effect on a GPU or on several
      devices.
    - `call`: members in one call of the compiled program, rounded up to whole blocks (None: equal shares for all cores,
      at most 4096 members each). The memory of the simulation grows with `call`, not with N. A new value of `call`
      requires a new compilation. Each core runs one call at a time. If there are fewer calls than cores, some cores are
      idle.
    - `block`: members that run together in vector instructions (None: as many as fit the first-level cache,
      fewer in a small ensemble).
    - `compiled`: how the program is compiled: `one_kernel`, the fast path; `compiled_quickly` without it, for functions
      of LAPACK, such as eigenvalues, which it does not support; `compiled_quickest` also for programs that run briefly.
    - `vectorised`: whether the function is vectorised already. It then receives the tree of a block of members, and the
      tree `in_axes` of `jax.vmap` (0 or None for each leaf). Each leaf of its result has a leading axis of the block.

    Returns NumPy arrays in member order, every leaf with a leading axis [N].

    Raises ValueError if the lengths of two leaves differ, if no leaf is an array, or if one is traced.
    """
    require_concrete("ensemble", tree)
    for name, value in (("threads", threads), ("call", call), ("block", block)):
        require_number(name, value, 1, whole=True, optional=True)
    leaves, structure = jax.tree.flatten(tree)
    members, moves = size(tree), varying(tree)
    moving = [np.asarray(x) for x, varies in zip(leaves, moves, strict=True) if varies]
    shared = tuple(x for x, varies in zip(leaves, moves, strict=True) if not varies)
    workers, call, block = _division(members, threads, call, block)
    program = _program(len(jax.devices()), compiled)

    def run_call(start: int) -> Mapped:
        # The last call may hold fewer members than its length: its last member is repeated.
        index = np.minimum(np.arange(start, start + call), members - 1)
        parts = Parts(tuple(x[index] for x in moving), shared)
        results = program(parts, function=function, moves=moves, tree=structure, block=block, vectorised=vectorised)
        return jax.tree.map(np.asarray, results)

    starts = range(0, members, call)
    if min(workers, len(starts)) == 1:  # a thread would cost more than a short run
        parts = [run_call(start) for start in starts]
    else:
        with ThreadPoolExecutor(min(workers, len(starts))) as pool:
            parts = list(pool.map(run_call, starts))
    whole = jax.tree.map(lambda *xs: np.concatenate(xs), *parts)
    return jax.tree.map(lambda x: x[:members], whole)


def _division(members: int, threads: int | None, call: int | None, block: int | None) -> tuple[int, int, int]:
    """Return the number of threads, and of members in a call and in a block. All calls run one compiled program."""
    devices = jax.devices()
    single_cpu = len(devices) == 1 and devices[0].platform == "cpu"
    workers = (threads or cores()) if single_cpu else 1
    calls = max(-(-members // (MOST_CALL * workers)), 1) * workers
    share = max(-(-members // calls), LEAST_BYTES // jnp.result_type(float).itemsize)
    per_call = call or min(share, members)
    block = block or block_length(per_call)
    multiple = block * len(devices)
    return workers, -(-per_call // multiple) * multiple, block


def size(tree: object) -> int:
    """Return the number of members: the common length of the leaves' axis of members."""
    lengths = {np.shape(x)[0] for x, varies in zip(jax.tree.leaves(tree), varying(tree), strict=True) if varies}
    if len(lengths) != 1:
        listing = " and ".join(str(n) for n in sorted(lengths)) or "none"
        raise ValueError(
            f"ensemble: lengths of the array leaves: {listing}. There must be exactly one length. Give "
            "scenario.member = np.arange(N), and every other leaf that varies as an array with N entries."
        )
    return lengths.pop()


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _blocks(
    parts: Parts, *, function: Callable[..., Mapped], moves: tuple[bool, ...], tree: Any, block: int, vectorised: bool
) -> Mapped:
    """Run all members of a call: on a CPU, in a loop over blocks, vectorised over a block; elsewhere, all at once."""
    axes = jax.tree.unflatten(tree, [0 if varies else None for varies in moves])

    def together(moving: tuple[Array, ...]) -> Mapped:
        own, common = iter(moving), iter(parts.shared)
        members = jax.tree.unflatten(tree, [next(own) if varies else next(common) for varies in moves])
        return function(members, axes) if vectorised else jax.vmap(function, (axes,))(members)

    if jax.default_backend() != "cpu":
        return together(parts.moving)
    cut = jax.tree.map(lambda x: x.reshape(-1, block, *x.shape[1:]), parts.moving)
    results = lax.map(together, cut)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), results)


STATIC = ("function", "moves", "tree", "block", "vectorised")


@functools.cache
def _program(devices: int, compiled: Callable[..., Callable]) -> Callable[..., Any]:
    """Return the program that `compiled` makes: for one device, or with members sharded over several devices."""
    if devices == 1:
        return compiled(_blocks, static_argnames=STATIC)
    mesh = Mesh(np.asarray(jax.devices()[:devices]), (MEMBERS,))
    by_member, replicated = PartitionSpec(MEMBERS), PartitionSpec()

    def sharded(parts: Parts, **static: object) -> object:
        one = functools.partial(_blocks, **static)
        # Members exchange no data, so the check of replication is not needed, and constants may stay unsharded.
        where = {"mesh": mesh, "in_specs": (Parts(by_member, replicated),), "out_specs": by_member, "check_vma": False}
        return jax.shard_map(one, **where)(parts)

    kernel = compiled(sharded, static_argnames=STATIC)

    def placed(parts: Parts, **static: object) -> object:
        moving = jax.device_put(parts.moving, NamedSharding(mesh, by_member))
        return kernel(Parts(moving, jax.device_put(parts.shared, NamedSharding(mesh, replicated))), **static)

    return placed
