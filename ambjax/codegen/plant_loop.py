"""The loop with a compiled plant, or a compiled loop, compared with JAX's loop.

JAX's loop holds the disturbances over each sample, as the exported plant does.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.codegen.c99.machine import Compiled
from ambjax.codegen.closed_loop import LoopComparison, times_of
from ambjax.codegen.controller import Controller, controller_of
from ambjax.codegen.loop_step import LoopStep
from ambjax.codegen.plant_step import PlantStep
from ambjax.codegen.series import series
from ambjax.codegen.trace import arguments
from ambjax.codegen.twins import LoopCase, horizons

# Function that returns the controller's voltage (V) for readings and reference, [7], and stores the controller's state.
Law = Callable[[np.ndarray], float]


def compare_blocks(case: LoopCase, machines: dict[str, Compiled]) -> dict[str, LoopComparison]:
    """Compare the loop of each compiled plant, or each compiled loop, to JAX's loop. Keys: the precisions."""
    block = next(iter(machines.values())).trace.block
    plant = block.plant if isinstance(block, LoopStep) else block
    assert isinstance(plant, PlantStep)
    case = case._replace(clock=case.clock.with_method(plant.method))
    controller = controller_of(case.cascade, case.scenario.u_max, plant.period, case.scenario)
    found = {}
    for precision, horizon in horizons(case, list(machines), held=True).items():
        inputs = series(case.cascade, case.scenario, case.clock, max(horizon.samples, 1))
        machine = machines[precision]
        z = looped(machine, inputs, None if block.noun == "loop" else law_of(controller))
        found[precision] = LoopComparison(horizon, times_of(z, horizon))
    return found


def looped(machine: Compiled, inputs: dict[str, np.ndarray], law: Law | None) -> np.ndarray:
    """Return the true z (m) of a loop at every sample of `inputs`. `law`: the controller of a compiled plant."""
    names, u = [x.name for x in machine.trace.inputs], 0.0
    count = len(inputs["r"])
    rows = np.array([inputs.get(name, np.zeros(count)) for name in names]).T
    references = np.array([inputs[name] for name in ("r", "r_dot", "r_ddot", "r_dddot")]).T
    at = [x.name for x, _ in machine.trace.outputs].index("z_true")
    machine.state[()] = np.zeros((), machine.memory)
    z = np.empty(count)
    for n in range(count):
        machine.inputs[:] = rows[n]
        if law is not None:
            machine.inputs[names.index("u")] = u
        machine.step()
        z[n] = machine.outputs[at]
        if law is not None:
            u = law(np.concatenate([machine.outputs[:3], references[n]]))
    return z


def law_of(controller: Controller) -> Law:
    """Return JAX's step of a controller as a function with a state."""
    parameters, memory, _, period = arguments(controller)
    read = frozenset(controller.inputs)

    @jax.jit
    def step(memory: Any, x: jax.Array) -> tuple[Any, jax.Array]:
        memory, outputs, _ = controller.step(parameters, memory, controller.ports(*x), period, read)
        return memory, outputs.u

    def law(x: np.ndarray) -> float:
        nonlocal memory
        memory, u = step(memory, jnp.asarray(x, float))
        return float(u)

    return law
