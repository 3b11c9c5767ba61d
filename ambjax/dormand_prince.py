"""The explicit method of Dormand and Prince, order 5: for held noise on smooth gains, where accuracy sets the step."""

from ambjax._pytree import record
from ambjax.integrate import _Explicit


@record
class DormandPrince(_Explicit):
    """Dormand and Prince's method with equal substeps, order 5.

    J. Comput. Appl. Math. 6 (1980) 19-26. Its seventh stage serves an error estimate only, which equal steps do not
    need.
    """

    limit = 3.3
    TIMES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0)
    ROWS = (
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
        (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    )

    def __str__(self) -> str:
        return f"Dormand-Prince 5, {self.substeps} substeps"
