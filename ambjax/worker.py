"""What a process must do before it simulates, and what worker processes are sent."""

import os
import pathlib
from typing import Any

from ambjax.ensemble.study import Study


def prepare() -> None:
    """float64 unless JAX_ENABLE_X64 says otherwise, and compilations kept between runs."""
    import jax
    import platformdirs

    if "JAX_ENABLE_X64" not in os.environ:  # jax has been imported by now, so setting it there would be too late
        jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = pathlib.Path(platformdirs.user_cache_dir("ambjax")) / "compiled"
        try:
            cache.mkdir(parents=True, exist_ok=True)
        except OSError:
            return  # a home that cannot be written costs time, not correctness
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)


def work(study: Study, start: int, stop: int, call: int) -> dict[str, Any]:
    """Members start <= k < stop of a study, in a process of its own, on one core."""
    prepare()
    return study.columns(start, stop, call=call, threads=1)
