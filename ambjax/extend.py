"""What an extension of ambjax needs: records and their fields, smooth signs, and the fast path for whole functions.

GAINS are the ends of a gain.
"""

from ambjax.compiler.fast_path import one_kernel
from ambjax.numerics.records import GAINS, Scalar, canonical, leaf, record, static, validate
from ambjax.numerics.smooth import TWO_OVER_PI

__all__ = ["GAINS", "TWO_OVER_PI", "Scalar", "canonical", "leaf", "one_kernel", "record", "static", "validate"]
