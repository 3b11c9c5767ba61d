"""Run pytest many times without importing the same packages each time: one parent imports them and forks.

The parent (`python -P tests/forked.py`) imports packages of third parties only, never the project's own, and starts no
thread and no backend of JAX. For each request, a line of JSON on its standard input, it forks a child that runs pytest
in the folder of the request. It answers with a line that holds the exit code.
"""

import contextlib
import importlib
import importlib.util
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

PACKAGES = ("jax", "jax.numpy", "numpy", "scipy.integrate", "scipy.optimize", "scipy.signal", "optax", "pytest")
PACKAGES += ("jax.experimental.pjit", "matplotlib.pyplot", "hypothesis", "hypothesis.strategies")
OWN = ("ambjax", "tuning")
# Read by the packages when they are imported. tests/conftest.py gives JAX the same values. One thread for BLAS: a
# process with threads must not fork.
SETTINGS = {
    "JAX_ENABLE_X64": "1",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05",
    "OPENBLAS_NUM_THREADS": "1",
    "MPLBACKEND": "Agg",
    "PYTHONDONTWRITEBYTECODE": "1",
}
OVER_TIME = -1  # exit code of a run that its time limit ended


class Parent:
    """A process that runs pytest in forked children, one at a time."""

    def __init__(self, env: dict[str, str]):
        """Start it. `env` is the environment of the children, which SETTINGS complete."""
        self._process = subprocess.Popen(
            [sys.executable, "-P", __file__],
            env=env | SETTINGS,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def run(self, folder: str, words: list[str], limit_s: float) -> tuple[int, str]:
        """Return the exit code of pytest and its output, or OVER_TIME and the output until then."""
        output = pathlib.Path(folder) / "pytest-output.txt"
        request = {"folder": folder, "words": words, "output": str(output), "limit_s": limit_s}
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        if not (answer := self._process.stdout.readline()):
            raise RuntimeError(f"the process that forks the tests ended with code {self._process.wait()}.")
        return json.loads(answer), output.read_text(encoding="utf-8", errors="replace")

    def close(self) -> None:
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def _child(folder: str, words: list[str], output: str) -> int:
    """Run pytest on the packages of `folder`; return its exit code."""
    os.setsid()  # its processes end with it
    with open(os.devnull) as nothing, open(output, "wb") as file:  # noqa: PTH123
        os.dup2(nothing.fileno(), 0)
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    os.chdir(folder)
    os.environ["PYTHONPATH"] = folder
    sys.path.insert(0, folder)
    sys.dont_write_bytecode = True
    for name in OWN:
        init = pathlib.Path(folder) / name / "__init__.py"
        spec = importlib.util.find_spec(name) if init.exists() else None
        assert not spec or spec.origin == str(init), f"{name} would be imported from {spec.origin}, not from {folder}"
    import pytest

    # hypothesis is imported before pytest can rewrite its assertions
    return int(pytest.main(["-W", "ignore::pytest.PytestAssertRewriteWarning", *words]))


def _result(pid: int, limit_s: float) -> int:
    """Wait for a child and return its exit code; after `limit_s`, end it with all its processes."""
    ends = time.monotonic() + limit_s
    while time.monotonic() < ends:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return OVER_TIME


def serve() -> None:
    """Import the packages, then answer requests until standard input ends."""
    for name in PACKAGES:
        importlib.import_module(name)
    assert not any(name in sys.modules for name in OWN)
    threads = pathlib.Path("/proc/self/task")
    assert not threads.exists() or len(list(threads.iterdir())) == 1, "a process with threads must not fork"
    for line in sys.stdin:
        request = json.loads(line)
        limit_s = request.pop("limit_s")
        if pid := os.fork():
            print(json.dumps(_result(pid, limit_s)), flush=True)
            continue
        code = 70
        try:
            code = _child(**request)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)


if __name__ == "__main__":
    serve()
