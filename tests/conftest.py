import collections
import ctypes
import gc
import os
import pathlib
import shutil
import sys

import pytest
import quick
from profiles import THOROUGH

from ambjax.host.command_line import GC_THRESHOLDS

# One cache of compiled programs for all processes of a run, kept for the next run; removed when it is larger (bytes).
CACHE = pathlib.Path(__file__).parent.parent / ".pytest_cache" / "programs"
LARGEST = 512 * 2**20
# Resident memory above which the programs of a module are released when it ends (bytes).
MUCH = 700 * 2**20

# Modules with few tests, some of which take 10 s and more.
LONG = "mutations", "paper", "study_runs", "machine", "docs", "machine_tuning", "stability", "case_fuzz"

# Workers whose threads share the cores take an eighth more time.
_worker = os.environ.get("PYTEST_XDIST_WORKER", "")
if _worker.startswith("gw"):
    quick.take_core(int(_worker[2:]))

# Compilation takes most of the tests' time. The thorough profile compiles as users do.
if not THOROUGH:
    os.environ.setdefault("XLA_FLAGS", quick.flags())

os.environ.setdefault("JAX_ENABLE_X64", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the commands
# The position in the source of every operation would be collected in each lowering.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")


# As in the commands.
gc.set_threshold(*GC_THRESHOLDS)


def pytest_configure(config):
    if not hasattr(config, "workerinput") and sum(file.stat().st_size for file in CACHE.glob("*")) > LARGEST:
        shutil.rmtree(CACHE)


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config, items):
    """A thorough test is slow, and runs in the thorough profile only. Long tests and large modules run first.

    Otherwise a worker would start a long test at the end, when the other worker has no more tests.
    """
    left_out = [] if THOROUGH else [item for item in items if item.get_closest_marker("thorough")]
    for item in items:
        if item.get_closest_marker("thorough"):
            item.add_marker(pytest.mark.slow)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("thorough")]
    result = yield
    sizes = collections.Counter(item.path.name for item in items)
    items.sort(key=lambda item: (item.path.stem.removeprefix("test_") not in LONG, -sizes[item.path.name]))
    return result


def pytest_collection_finish(session):
    """Exclude what the imports have allocated from later garbage collections."""
    gc.collect()
    gc.freeze()


def _resident() -> float:
    """Return the resident memory of this process (bytes); infinity where it is not known."""
    if sys.platform != "linux":
        return float("inf")
    return int(pathlib.Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(autouse=True, scope="module")
def _release_programs():
    """Release compiled programs at the end of a module if memory is above MUCH. Other modules use them otherwise."""
    yield
    if _resident() < MUCH:
        return
    import jax

    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":  # the C library keeps freed memory otherwise
        getattr(ctypes.CDLL(None), "malloc_trim", lambda _: 0)(0)


@pytest.fixture(autouse=True, scope="session")
def _strict():
    """Let an error in a description of a result end the command, so that a test sees it."""
    from ambjax.results import outputs

    outputs.STRICT = True


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A separate folder for the test; the compilation cache is beside this folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path.parent / "cache"))
