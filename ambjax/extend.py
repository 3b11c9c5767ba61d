"""What an extension of ambjax needs: records and their fields, and the fast path for whole functions."""

from ambjax._kernel import one_kernel
from ambjax._pytree import Scalar, canonical, leaf, record, static, validate

__all__ = ["Scalar", "canonical", "leaf", "one_kernel", "record", "static", "validate"]
