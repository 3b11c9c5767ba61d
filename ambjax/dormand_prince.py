"""The explicit method of Dormand and Prince, order 5: for held noise on smooth gains, where accuracy sets the step."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax._pytree import Scalar, record
from ambjax.integrate import Problem, Times, _Fixed, axpy, choose

# Dormand and Prince, J. Comput. Appl. Math. 6 (1980) 19-26: times, stages and the weights of order 5. The seventh stage
# serves an error estimate only, which equal steps do not need.
TIMES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0)
ROWS = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
STAGES = len(TIMES)
# PUSH[j][n]: what stage j adds to the n-th of the rows still to come; rows leave the queue as their stages begin.
PUSH = tuple(tuple(ROWS[j + n][j] if j + n < STAGES else 0.0 for n in range(STAGES)) for j in range(STAGES))


@record
class DormandPrince(_Fixed):
    """Dormand and Prince's method with equal substeps, order 5.

    Each stage, once known, is pushed into all rows that will need it, in a loop: six evaluations of the
    right-hand side and none of its terms twice.
    """

    limit = 3.3

    def _step(self, problem: Problem, at: Times, h: Scalar, state: Any) -> Any:
        inputs = [problem.inputs(at(share)) for share in TIMES]
        table = jnp.asarray(PUSH, jnp.result_type(float))

        def stage(j: Array, carry: tuple[list[Any], Any]) -> tuple[list[Any], Any]:
            queue, k = carry
            queue = [axpy(row, (h * table[j, n], k)) for n, row in enumerate(queue)]
            now = inputs[1]
            for n in range(2, STAGES):
                now = choose(j + 1 == n, inputs[n], now)
            return [*queue[1:], queue[-1]], problem.rates(now, queue[0])

        begin = ([state] * STAGES, problem.rates(inputs[0], state))
        queue, k = lax.fori_loop(0, STAGES - 1, stage, begin)
        return jax.tree.map(lambda row, rate: row + h * ROWS[-1][-1] * rate, queue[0], k)

    def __str__(self) -> str:
        return f"Dormand-Prince 5, {self.substeps} substeps"
