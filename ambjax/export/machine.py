"""The C compiler of this machine, and the controller that it makes as a function of Python."""

import ctypes
import os
import pathlib
import shutil
import subprocess
from typing import Any

import numpy as np

from ambjax.export.controller import INPUTS
from ambjax.export.reference import Points, Results
from ambjax.export.statements import PRECISIONS
from ambjax.export.trace import Trace

STRICT = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic", "-Werror"]
EXACT = "-ffp-contract=off"
SANITIZED = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


def compiler() -> str:
    """The C compiler: $CC, or cc, gcc or clang. Raises ValueError where there is none."""
    asked = os.environ.get("CC")
    for name in [asked] if asked else ["cc", "gcc", "clang"]:
        if found := shutil.which(name):
            return found
    raise ValueError(
        f"--verify: there is no C compiler ({asked or 'cc, gcc or clang'}). Install one, name it in CC, or leave out "
        "--verify."
    )


def build(sources: list[pathlib.Path], target: pathlib.Path, *flags: str) -> str:
    """Compile; the compiler's complaint, empty if there is none."""
    command = [compiler(), *STRICT, EXACT, *flags, *map(str, sources), "-o", str(target), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit code {done.returncode}"


class Compiled:
    """A controller in a shared library. `state` is its memory: numbers, then whether it was started."""

    def __init__(self, library: pathlib.Path, trace: Trace, prefix: str):
        self.trace, real = trace, np.dtype(PRECISIONS[trace.precision])
        loaded = ctypes.CDLL(str(library))
        self._step = getattr(loaded, f"{prefix}_step")
        self._step.restype = ctypes.c_uint32
        self.memory = np.dtype([("numbers", real, (len(trace.state),)), ("started", np.uint32)], align=True)
        count = len(trace.parameters)
        default = (ctypes.c_char * (count * real.itemsize)).in_dll(loaded, f"{prefix}_default")
        self.parameters = np.frombuffer(bytes(default), real).copy()
        self.state = np.zeros((), self.memory)
        self.inputs, self.outputs = np.zeros(len(INPUTS), real), np.zeros(len(trace.outputs), real)
        self._at = [x.ctypes.data_as(ctypes.c_void_p) for x in (self.parameters, self.state, self.inputs, self.outputs)]
        self._keeps: Any = loaded

    def step(self) -> int:
        """One sample, of `inputs`, into `state` and `outputs`."""
        return self._step(*self._at)

    def results(self, at: Points) -> Results:
        """The step at these points."""
        count = at.started.size
        state, started = np.empty_like(at.state), np.empty(count, bool)
        outputs, bits = np.empty((len(self.outputs), count), at.state.dtype), np.empty(count, np.int64)
        for n in range(count):
            self.state["numbers"], self.state["started"] = at.state[:, n], at.started[n]
            self.inputs[:] = at.inputs[:, n]
            bits[n] = self.step()
            state[:, n], started[n], outputs[:, n] = self.state["numbers"], self.state["started"], self.outputs
        return Results(state, started, outputs, bits)
