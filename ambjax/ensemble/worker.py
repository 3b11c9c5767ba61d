"""What a process must do before it simulates, and what worker processes are sent."""

import contextlib
import multiprocessing
import os
import pathlib
import signal
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any

from ambjax.ensemble.study import Study

# Members in one call of the compiled program on a CPU. Fixed, because a last digit may depend on it: a study's numbers
# must not depend on the cores of the machine, nor on where its chunks run.
CALL = 64
# Size of the cache of compiled programs, in bytes. JAX removes the entries that were not used for longest.
CACHE_SIZE = 256 * 2**20


def prepare() -> None:
    """Configure JAX for a command: float64 unless JAX_ENABLE_X64 is set, and a cache of compiled programs.

    The cache is bounded and can be shared by processes. JAX_COMPILATION_CACHE_DIR replaces it.

    Raises ValueError where JAX has no device of the kind that JAX_PLATFORMS asks for.
    """
    import jax
    import platformdirs

    if "JAX_ENABLE_X64" not in os.environ:  # jax has been imported by now, so setting it there would be too late
        jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        # Without a cache, because there is no home directory or the disk is full, a run is slower and no less correct.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
        with contextlib.suppress(OSError, RuntimeError):
            cache = pathlib.Path(platformdirs.user_cache_dir("ambjax")) / "programs"
            cache.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(cache))
            jax.config.update("jax_compilation_cache_max_size", CACHE_SIZE)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
    if platforms := os.environ.get("JAX_PLATFORMS"):
        try:
            jax.default_backend()
        except (AssertionError, RuntimeError) as error:  # the first is all it says of a known kind without a device
            why = str(error).partition("\n")[0] or "none of them is here"
            raise ValueError(f"JAX_PLATFORMS={platforms}: {why}. Leave it out, or set it to cpu.") from None


def chunk(
    study: Study, start: int, stop: int, size: int, threads: int | None = None, *, lost: bool = False
) -> dict[str, Any]:
    """Members start <= k < stop of a study that is cut into chunks of `size`, on so many cores (None: all).

    `lost` as in `Study.columns`.
    """
    import jax

    call = min(size, CALL) if jax.default_backend() == "cpu" else size
    return study.columns(start, stop, call=call, threads=threads, lost=lost)


def work(study: Study, start: int, stop: int, size: int) -> dict[str, Any]:
    """A chunk of a study in a process of its own, on one core."""
    prepare()
    return chunk(study, start, stop, size, threads=1)


@contextlib.contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Prepared worker processes that end at once with the block if it fails, and with this process however it ends."""
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_begin) as pool:
        try:
            yield pool
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise


@contextlib.contextmanager
def ignore_sigint() -> Iterator[None]:
    """Processes that are started in this block do not hear Ctrl-C, which is then their parent's alone."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin() -> None:
    prepare()

    def wait() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
