"""Whole rollouts in one GPU kernel: the kernel contains the time loop, and each thread simulates one member.

If the time loop is outside the kernel, every step launches several kernels, and all states pass through the memory of
the GPU. Here Pallas (through Triton) compiles one program that loads the numbers of its members, loops over all samples
in registers, and stores the result of the fold. The kernel contains the code of the ordinary rollout; only the random
numbers of jax.random are drawn before the kernel starts.
"""

import dataclasses
import functools
import importlib
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import run_ensemble, size
from ambjax.numerics.records import canonical
from ambjax.numerics.shapes import varying
from ambjax.simulation.clock import Clock, takes_case
from ambjax.simulation.explicit import RK4
from ambjax.simulation.folds import Fold
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.rollout import Result, prepare, run
from ambjax.world.scenario import Scenario

# Threads of a warp, and largest number of warps of a program. A thread simulates one member, or block/1024 members in
# larger blocks.
WARP, MOST_WARPS = 32, 32
BLOCK = 128


@takes_case
def run_on_gpu(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    *,
    fold: Fold | None,
    block: int = BLOCK,
    interpret: bool = False,
) -> Result:
    """Simulate every member of an ensemble on a GPU, in one kernel.

    Arguments and results are those of `run_ensemble`, without rows: each leaf of `cascade`, `scenario` and `fold` is a
    number, shared by all members, or an array [N]. Noise is that of `rollout`.

    - `clock`: its method must be RK4.
    - `block`: members of one Pallas program, a power of two, at least 32.
    - `interpret`: run the kernel in Pallas's interpreter, which works on any device but is slow. For tests.

    Returns a Result whose leaves have shape [N], in member order. JAX deprecated Pallas's Triton back end in 0.11.0.
    If the installed JAX has none, a UserWarning says so, and `run_ensemble` simulates the members.

    Raises ValueError as `run_ensemble` does, and if there is no GPU, for another method, a cascade on a processor, a
    recorded signal, or an invalid `block`.
    """
    _, clock = prepare(cascade, scenario, clock)
    if not isinstance(clock.method, RK4):
        raise ValueError(f"clock.method = {clock.method}: run_on_gpu integrates with RK4 only. Use RK4(substeps).")
    if cascade.sampled:
        raise ValueError("processor: run_on_gpu simulates cascades in continuous time only. Use run_ensemble.")
    if block < WARP or block & (block - 1):
        raise ValueError(f"block = {block}: it must be a power of two, at least {WARP}. Use {BLOCK}, for example.")
    cascade, scenario, clock, fold = canonical((cascade, scenario, clock, fold))
    members = size((cascade, scenario, clock, fold))
    if not interpret and (backend := jax.default_backend()) != "gpu":
        raise ValueError(f"run_on_gpu needs a GPU, and JAX runs on this backend: {backend}. Use run_ensemble.")
    try:
        importlib.import_module("jax.experimental.pallas.triton")
    except ImportError:
        message = f"JAX {jax.__version__} has no Triton back end of Pallas: run_ensemble simulates the members instead."
        warnings.warn(message, stacklevel=2)
        return run_ensemble(cascade, scenario, clock, fold=fold)
    return _in_one_kernel(cascade, scenario, clock, fold, members=members, block=block, interpret=interpret)


@functools.partial(jax.jit, static_argnames=("members", "block", "interpret"))
def _in_one_kernel(
    cascade: Cascade, scenario: Scenario, clock: Clock, fold: Fold | None, *, members: int, block: int, interpret: bool
) -> Result:
    """Build the kernel, run it on all members, and return their outcomes [N].

    Each program of the grid reads its block of the members' numbers and all shared numbers.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    scenario, key = _with_draws(scenario, members)
    whole = ClosedLoop(cascade, scenario, key), clock, fold
    (leaves, tree), axes = jax.tree.flatten(whole), [0 if varies else None for varies in varying(whole)]
    traced, results = _traced(leaves, tree, axes, block)
    programs = -(-members // block)
    # The last program fills its unused threads with copies of the last member.
    index = jnp.minimum(jnp.arange(programs * block), members - 1)
    operands = [x[None] if axis is None else x[index] for x, axis in zip(leaves, axes, strict=True)]

    def kernel(*refs: Any) -> None:
        numbers = [ref[0] if axis is None else ref[...] for ref, axis in zip(refs, axes, strict=False)]
        for ref, value in zip(refs[len(axes) :], jaxpr_as_fun(traced)(*numbers), strict=True):
            ref[...] = value

    def own(x: Array | jax.ShapeDtypeStruct) -> pl.BlockSpec:
        return pl.BlockSpec((block, *x.shape[1:]), lambda n: (n, *(0 for _ in x.shape[1:])))

    def shared(x: Array) -> pl.BlockSpec:
        return pl.BlockSpec(x.shape, lambda _: (0,) * x.ndim)

    leaves, structure = jax.tree.flatten(results)
    outputs = pl.pallas_call(
        kernel,
        grid=(programs,),
        in_specs=[shared(x) if axis is None else own(x) for x, axis in zip(operands, axes, strict=True)],
        out_specs=[own(x) for x in leaves],
        out_shape=[jax.ShapeDtypeStruct((programs * x.shape[0], *x.shape[1:]), x.dtype) for x in leaves],
        compiler_params=triton.CompilerParams(num_warps=min(block // WARP, MOST_WARPS)),
        interpret=interpret,
    )(*operands)
    return jax.tree.unflatten(structure, [x[:members] for x in outputs])


def _traced(leaves: Sequence[Array], tree: Any, axes: Sequence[int | None], block: int) -> tuple[ClosedJaxpr, Any]:
    """Trace the rollouts of `block` members, and return the shapes too. Raises ValueError for a recorded signal."""
    member = jax.vmap(lambda *leaves: run(*jax.tree.unflatten(tree, leaves), record_every=0), in_axes=axes)
    shapes = [
        jax.ShapeDtypeStruct(x.shape if axis is None else (block, *x.shape[1:]), x.dtype)
        for x, axis in zip(leaves, axes, strict=True)
    ]
    traced, results = jax.make_jaxpr(member, return_shape=True)(*shapes)
    if any(np.ndim(constant) for constant in traced.consts):
        raise ValueError("scenario: run_on_gpu cannot simulate a recorded signal (Recorded). Use run_ensemble.")
    return traced, results


def _with_draws(scenario: Scenario, members: int) -> tuple[Scenario, tuple[Array, Array]]:
    """Draw outside the kernel what needs jax.random: the members' random signals, and their keys as two words [N]."""
    leaves, tree = jax.tree.flatten(scenario)
    # vmap needs an argument with a mapped axis, and the scenario may have none: hence arange(members).
    axes = ([0 if varies else None for varies in varying(scenario)], 0)

    def one(leaves: list[Array], _: Array) -> tuple[Scenario | None, tuple[Array, Array]]:
        alone = jax.tree.unflatten(tree, leaves)
        draws = alone.realised()
        return None if draws is alone else draws, alone.words()

    draws, words = jax.vmap(one, in_axes=axes)(leaves, jnp.arange(members))
    scenario = draws or scenario  # without random signals, shared leaves stay shared
    unused = jnp.zeros((), jnp.result_type(int))
    return dataclasses.replace(scenario, seed=unused, member=unused), words
