"""The sampled loop as JavaScript, generated from a trace of one sample of the simulator: laws, plant and metrics.

Every number of the case is a parameter, so the page can change it without a new trace.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ambjax.cases.reader import Case
from ambjax.codegen.trace import precision
from ambjax.numerics.records import canonical
from ambjax.page.functions import function_source, loop_source, operands_of, piece_of
from ambjax.page.loop_functions import LoopFunctions, loop_parameters

# Signals in a row, which the page draws; the currents of both coils follow. A row of a member has the first three only.
SIGNALS = ("z", "alive", "r", "u", "u_mean", "i_ref", "q_z", "z_measured", "sigma", "v_tilde", "i")
COILS = ("i_1", "i_2")


class LoopScript(NamedTuple):
    """The loop as JavaScript.

    - `source`: the functions `startLoop(P, W, out)`, `makeLoop(P)`, `makeMember(P)` and `loopMetrics(P, S, out)`.
      W: normal random numbers. `out`: array of the result. See `functions.loop_source` for the functions that
      `makeLoop` and `makeMember` return. That of a member does not update the metrics in S.
    - `parameters`: the case's values of the parameters P.
    - `metrics`: names of the metrics, in the order of `out` of `loopMetrics`.
    - `states`: number of states S.
    - `lost`: index of the state that contains the status code of the rotor.
    """

    source: str
    parameters: list[float]
    metrics: list[str]
    states: int
    lost: int


def loop_script(case: Case, any_delay: bool = False) -> LoopScript:
    """Return the loop of a case on a processor as JavaScript. `any_delay`: for every delay that the page
    admits, not only that of the case.

    Raises ValueError for a part of the case that scalar code cannot express.
    """
    with precision("double"):
        numbers = canonical(loop_parameters(case, any_delay))
        functions = LoopFunctions(case.clock)
        zero = jnp.zeros(())
        normals = (zero, zero, zero)
        start = piece_of(functions.start, "pw", (numbers, normals))
        shapes = jax.eval_shape(functions.start, numbers, normals)
        progress = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        step = piece_of(functions.step, "pswn", (numbers, progress, normals, zero))
        result = piece_of(functions.result, "ps", (numbers, progress))
    _, row, coils = step.results
    shown = [getattr(row, name) for name in SIGNALS] + list(coils)
    every = operands_of(step.results[0])
    source = "\n".join(
        [
            function_source(start, "startLoop", "PW", start.results),
            loop_source(step, "makeLoop", shown, every),
            loop_source(step, "makeMember", shown[:3], []),
            function_source(result, "loopMetrics", "PS", result.results),
        ]
    )
    values = [float(x) for x in jax.tree.leaves(numbers)]
    lost = jax.tree.leaves(jax.tree.map(lambda x: x is shapes.ending.lost_code, shapes)).index(True)
    return LoopScript(source, values, list(result.results), len(every), lost)
