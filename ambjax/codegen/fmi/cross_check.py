"""Reference data of an FMU in the format of FMI's cross-check: the signals of a case, and the outputs of JAX."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.codegen.block import Block
from ambjax.codegen.of_case import block_of
from ambjax.codegen.series import series
from ambjax.codegen.trace import arguments
from ambjax.compiler.short_compilation import precision
from ambjax.control.cascade import Cascade
from ambjax.numerics.records import replaced
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import rollout
from ambjax.world.scenario import Scenario

# Largest number of samples of the reference data of each block. Those of a loop are few, because its signs amplify
# rounding errors. A plant alone is unstable: its data also end when an error has grown by the factor GROWTH.
SAMPLES = {"controller": 1000, "loop": 200, "plant": 1000}
GROWTH = 1e4


def run_block(block: Block, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run a block in JAX. Return its outputs [samples, outputs] and status [samples], the bits as an integer."""
    parameters, memory, _, period = arguments(block)
    read = frozenset(block.inputs)

    def one(memory: Any, x: Array) -> tuple[Any, tuple[Array, Array]]:
        memory, outputs, status = block.step(parameters, memory, block.ports(*x), period, read)
        bits = sum(jnp.where(bit, 1 << k, 0) for k, bit in enumerate(jax.tree.leaves(status)))
        return memory, (jnp.stack(jax.tree.leaves(outputs)), jnp.asarray(bits))

    outputs, bits = jax.jit(lambda rows: jax.lax.scan(one, memory, rows)[1])(jnp.asarray(rows))
    return np.asarray(outputs), np.asarray(bits)


def reference(block: Block, cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and outputs of a block's FMU in the loop of the case.

    Each is an array [instants, 1 + numbers] with the time (s) in the first column; the outputs have one instant more.
    The inputs of a row act in the communication step that begins at its time. For a plant and a loop, the first row is
    also the input of the step that reads the sensors at the start.
    """
    count = min(clock.samples, SAMPLES[block.noun])
    if block.noun == "plant":
        pole = float(scenario.plant.pole) * block.period
        count = max(min(count, int(math.log(GROWTH) / pole)), 1)
    given = series(cascade, scenario, clock, count + 1)
    if block.noun == "controller":
        short = replaced(clock, samples=count)
        read = rollout(cascade, scenario, short).trajectory.rows
        signals = {**given, "z": read.z_measured, "z_dot": read.z_dot, "i": read.i}
        rows = np.array([signals[name][:count] for name in block.inputs]).T
        found = np.concatenate([np.zeros((1, len(block.outputs))), run_block(block, rows)[0]])
    else:
        loop = block if block.noun == "loop" else block_of("loop", cascade, scenario, clock)
        plain = np.array([given[name] for name in loop.inputs]).T
        outputs = dict(zip(loop.outputs, run_block(loop, plain)[0].T, strict=True))
        late = [outputs[name][:count] if name == "u" else given[name][1:] for name in block.inputs]
        rows = np.array(late).T
        found = run_block(block, np.concatenate([rows[:1], rows]))[0]
    t = np.arange(count + 1) * block.period
    return np.column_stack([t[:-1], rows]), np.column_stack([t, found])


def files_of(
    block: Block, name: str, read: frozenset[str], cascade: Cascade, scenario: Scenario, clock: Clock
) -> dict[str, str]:
    """Return the texts of NAME_in.csv, NAME_ref.csv and NAME_ref.opt by file name.

    `read`: names of the inputs that the FMU has. Raises ValueError for a case that cannot be exported.
    """
    with precision("double"):
        inputs, outputs = reference(block, cascade, scenario, clock)
    named = {x: inputs[:, 1 + k] for k, x in enumerate(block.inputs) if x in read}
    options = {"StartTime": 0.0, "StopTime": float(outputs[-1, 0]), "StepSize": block.period, "RelTol": 1e-9}
    return {
        f"{name}_in.csv": _csv(["time", *named], np.column_stack([inputs[:, 0], *named.values()])),
        f"{name}_ref.csv": _csv(["time", *block.outputs], outputs),
        f"{name}_ref.opt": "".join(f"{key},{value!r}\n" for key, value in options.items()),
    }


def _csv(names: list[str], rows: np.ndarray) -> str:
    """Return the text of a CSV file: a line of quoted names, then the rows."""
    head = ",".join(f'"{name}"' for name in names)
    return "\n".join([head, *(",".join(map(repr, map(float, row))) for row in rows), ""])
