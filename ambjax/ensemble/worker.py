"""Worker processes: configuration of JAX, and the simulation of one chunk of a study."""

import contextlib
import multiprocessing
import os
import pathlib
import pickle
import signal
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor

from ambjax.compiler.traced_programs import store_in
from ambjax.ensemble.study import AnyStudy
from ambjax.host.sealed import Arrays

# Members in one call of the compiled program on a CPU. The last digit of a result may depend on it. It is fixed, so
# that no result depends on the number of cores or on the process that computes a chunk.
CALL = 64
# Size of the cache of compiled programs, in bytes. JAX removes the least recently used entries.
CACHE_SIZE = 256 * 2**20


def configure_jax() -> None:
    """Configure JAX for a command: float64 unless JAX_ENABLE_X64 is set, and caches of traced and compiled programs.

    Processes share the caches. That of compiled programs has at most CACHE_SIZE. If JAX_COMPILATION_CACHE_DIR is set,
    JAX uses that directory with its own settings instead, CACHE_SIZE does not apply, and traced programs are not kept.

    Raises ValueError if JAX has no device of the kind in JAX_PLATFORMS.
    """
    import jax
    import platformdirs

    if "JAX_ENABLE_X64" not in os.environ:  # jax is imported already, so the variable would have no effect
        jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        # No home directory or a full disk: the run continues without a cache, slower but with the same results.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
        with contextlib.suppress(OSError, RuntimeError):
            cache = pathlib.Path(platformdirs.user_cache_dir("ambjax")) / "programs"
            cache.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(cache))
            store_in(cache.with_name("traced"))
            jax.config.update("jax_compilation_cache_max_size", CACHE_SIZE)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if platforms := os.environ.get("JAX_PLATFORMS"):
        try:
            jax.default_backend()
        except (AssertionError, RuntimeError) as error:  # AssertionError: a known kind without a device
            why = str(error).partition("\n")[0] or "none of them is here"
            raise ValueError(f"JAX_PLATFORMS={platforms}: {why}. Unset it, or set it to cpu.") from None


def chunk(
    study: AnyStudy, start: int, stop: int, size: int, threads: int | None = None, *, lost: bool = False
) -> Arrays:
    """Simulate members start <= k < stop of a study, and return their columns.

    `size`: members in one call of the program on an accelerator; on a CPU, a call has CALL members. `threads`: CPU
    cores to use (None: all). `lost` is that of `Study.columns`.
    """
    import jax

    call = CALL if jax.default_backend() == "cpu" else size
    return study.columns(start, stop, call=call, threads=threads, lost=lost)


def work(study: bytes, start: int, stop: int, size: int) -> Arrays:
    """Simulate a chunk of a study in a worker process, on one core, and return its columns.

    `study`: pickled. Before JAX is configured, the arrays of JAX in it would be read as float32.
    """
    configure_jax()
    return chunk(pickle.loads(study), start, stop, size, threads=1)


@contextlib.contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Provide worker processes with JAX configured. If the block raises, the workers are terminated at once."""
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
    """Block SIGINT in this thread within the block, and permanently in the processes that it starts there."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin() -> None:
    """Configure a worker process, which then ends when its parent ends."""
    configure_jax()

    def wait() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
