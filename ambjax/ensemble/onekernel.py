"""Whole rollouts in one kernel, for accelerators: the time loop inside, one lane per member.

On an accelerator a loop outside a kernel launches several kernels per step, each of which takes longer than
the arithmetic. Here Pallas (through Triton) compiles one program that loads the members' numbers, loops over
all samples in registers and stores the result of the fold. The physics is the rollout's own, traced inside the
kernel; only the noise is written out, since kernels cannot call jax.random.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ambjax._pytree import Scalar, canonical, record
from ambjax.control.cascade import Cascade
from ambjax.control.laws import Measurement
from ambjax.integrate import RK4
from ambjax.loop import ClosedLoop
from ambjax.method import with_method
from ambjax.metrics import Fold
from ambjax.rollout import begin, check_inputs, finish, segment
from ambjax.scenario import Clock, Scenario

# One member per thread, 32 threads to a warp.
WARP = 32
BLOCK = 128
ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)


@record
class KernelLoop(ClosedLoop):
    """The closed loop with its noise written out; `key` is the member's key as two 32-bit words."""

    key: tuple[Scalar, Scalar]

    def hold(self, sample: Scalar) -> Measurement:
        """The same numbers as ClosedLoop.hold: bit for bit where lax.erf_inv is the same."""
        sensor = self.scenario.sensor
        if sensor is None:
            return super().hold(sample)
        key = threefry(self.key, (jnp.uint32(0), jnp.asarray(sample).astype(jnp.uint32)))
        w = [normal(key, n) for n in range(3)]
        return Measurement(sensor.std * w[0], sensor.std_z_dot * w[1], sensor.std_i * w[2])


def threefry(key: tuple[Scalar, Scalar], count: tuple[Scalar, Scalar]) -> tuple[Array, Array]:
    """Threefry-2x32 with 20 rounds (Salmon et al., SC 2011), the generator of jax.random."""
    (k_0, k_1), (x, y) = key, count
    schedule = (k_0, k_1, k_0 ^ k_1 ^ jnp.uint32(0x1BD11BDA))
    x, y = x + k_0, y + k_1
    for group in range(5):
        for turn in ROTATIONS[group % 2]:
            x = x + y
            y = ((y << jnp.uint32(turn)) | (y >> jnp.uint32(32 - turn))) ^ x
        x = x + schedule[(group + 1) % 3]
        y = y + schedule[(group + 2) % 3] + jnp.uint32(group + 1)
    return x, y


def normal(key: tuple[Array, Array], index: int) -> Array:
    """Element `index` of jax.random.normal(key, shape), in the working precision."""
    dtype = jnp.result_type(float)
    mantissa = jnp.finfo(dtype).nmant
    high, low = threefry(key, (jnp.uint32(0), jnp.uint32(index)))
    if dtype == jnp.float64:
        bits = (high.astype(jnp.uint64) << jnp.uint64(32)) | low.astype(jnp.uint64)
        unit = (bits >> jnp.uint64(64 - mantissa)) | jnp.uint64(np.float64(1).view(np.uint64))
    else:
        unit = ((high ^ low) >> jnp.uint32(32 - mantissa)) | jnp.uint32(np.float32(1).view(np.uint32))
    lowest = np.nextafter(np.array(-1, dtype), np.array(0, dtype), dtype=dtype)
    u = (lax.bitcast_convert_type(unit, dtype) - 1) * (1 - lowest) + lowest
    return jnp.asarray(np.sqrt(2), dtype) * lax.erf_inv(jnp.maximum(lowest, u))


def run_whole(
    cascade: Cascade, scenario: Scenario, clock: Clock, *, fold: Fold, block: int = BLOCK, interpret: bool = False
) -> Any:
    """The fold's result for every member, each leaf [N] in member order, by one kernel on an accelerator.

    Leaves of the cascade and the scenario are scalars, shared by all members, or have a leading axis [N]. `block`
    members share a program: a multiple of 32. `interpret` runs the kernel's program on any device, slowly: for tests.
    The method must be RK4. Noise is that of `rollout`, but for rounding in the accelerator's own functions.

    Raises ValueError as `rollout` does, and for another method, a wrong block and members that differ in number.
    """
    check_inputs(cascade, scenario, clock)
    clock = with_method(clock, cascade, scenario)
    if not isinstance(clock.method, RK4):
        raise ValueError(f"clock.method = {clock.method}: the whole-rollout kernel integrates with RK4 only.")
    if block < WARP or block % WARP:
        raise ValueError(f"block = {block}: it must be a positive multiple of {WARP}. Use {BLOCK}, for example.")
    members = count_members(cascade, scenario, fold)
    return _run_whole(*canonical((cascade, scenario, clock, fold)), members=members, block=block, interpret=interpret)


def count_members(*nodes: Any) -> int:
    """N, the length of every leaf that has an axis. ValueError if there is none, or if lengths differ."""
    lengths = {np.shape(x)[0] for x in jax.tree.leaves(nodes) if np.ndim(x)}
    if len(lengths) != 1:
        found = f"lengths {sorted(lengths)}" if lengths else "no leaf with an axis"
        raise ValueError(f"ensemble: {found}; at least one leaf must be an array [N], all with the same N.")
    return lengths.pop()


def _whole(system: KernelLoop, clock: Clock, fold: Fold) -> Any:
    """One member from start to end."""
    progress, _ = segment(system, clock, fold, begin(system, clock, fold), 0, clock.samples, 0)
    return finish(progress, None, fold).measured


def _run(
    cascade: Cascade, scenario: Scenario, clock: Clock, fold: Fold, *, members: int, block: int, interpret: bool
) -> Any:
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    words = jax.random.key_data(_keys(scenario, members))
    scenario = dataclasses.replace(scenario, seed=jnp.zeros((), int), member=jnp.zeros((), int))
    leaves, tree = jax.tree.flatten((KernelLoop(cascade, scenario, (words[:, 0], words[:, 1])), clock, fold))
    axes = [0 if x.ndim else None for x in leaves]
    one = jax.vmap(lambda *leaves: _whole(*jax.tree.unflatten(tree, leaves)), in_axes=axes)
    programs = pl.cdiv(members, block)
    padding = programs * block - members
    operands = [jnp.pad(x, (0, padding), mode="edge") if x.ndim else x[None] for x in leaves]
    per_lane, shared = pl.BlockSpec((block,), lambda n: (n,)), pl.BlockSpec((1,), lambda n: (0,))
    results, result_tree = jax.tree.flatten(jax.eval_shape(one, *leaves))

    def kernel(*refs: Any) -> None:
        numbers = [ref[...] if axis == 0 else ref[0] for ref, axis in zip(refs, axes, strict=False)]
        for ref, value in zip(refs[len(axes) :], jax.tree.leaves(one(*numbers)), strict=True):
            ref[...] = value

    found = pl.pallas_call(
        kernel,
        grid=(programs,),
        in_specs=[shared if axis is None else per_lane for axis in axes],
        out_specs=[per_lane] * len(results),
        out_shape=[jax.ShapeDtypeStruct((programs * block,), x.dtype) for x in results],
        compiler_params=triton.CompilerParams(num_warps=block // WARP),
        interpret=interpret,
    )(*operands)
    return jax.tree.unflatten(result_tree, [x[:members] for x in found])


_run_whole = jax.jit(_run, static_argnames=("members", "block", "interpret"))


def _keys(scenario: Scenario, members: int) -> Array:
    """The members' random keys [N]."""
    seed, member = (jnp.broadcast_to(jnp.asarray(x), (members,)) for x in (scenario.seed, scenario.member))
    return jax.vmap(lambda s, k: dataclasses.replace(scenario, seed=s, member=k).key())(seed, member)
