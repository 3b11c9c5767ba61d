"""One thread for the linear algebra of NumPy and SciPy, also for that within programs of JAX.

The matrices of an analysis are small. Where other programs use the cores, threads that wait for each other make it many
times slower. Commands set OPENBLAS_NUM_THREADS instead, before these libraries are loaded (`run_command`).
"""

import contextlib
from collections.abc import Iterator

from threadpoolctl import threadpool_limits


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread in this block, or in the function that it decorates."""
    import scipy.linalg  # noqa: F401  # loads the library whose threads JAX uses

    with threadpool_limits(1, "blas"):
        yield
