"""The C compiler of this machine, and the controller that it makes as a function of Python."""

import contextlib
import ctypes
import os
import pathlib
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from typing import Any

import numpy as np

from ambjax.export.controller import INPUTS
from ambjax.export.points import Points
from ambjax.export.reference import Results
from ambjax.export.statements import PRECISIONS
from ambjax.export.trace import Trace

STRICT = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic", "-Werror"]
EXACT = "-ffp-contract=off"
SANITIZED = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
SHARED = ["-shared", "-fPIC"]
# Seconds that a program may take.
PATIENCE = 60


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
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise ValueError(
            f"--verify: the C compiler {command[0]} cannot be run ({error.strerror}). Name another in CC, or leave out "
            "--verify."
        ) from None
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit code {done.returncode}"


def execute(program: pathlib.Path) -> tuple[int, str]:
    """Exit code of a compiled program, and what it said. Raises ValueError where it cannot be run, or does not end."""
    try:
        done = subprocess.run(
            [program], capture_output=True, text=True, errors="replace", check=False, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        raise ValueError(
            f"--verify: the program {program.name} did not end within {PATIENCE:g} s, and nothing is decided. Try "
            "again when the machine is less busy, or leave out --verify."
        ) from None
    except OSError as error:
        raise ValueError(_unused("run", program, error.strerror or str(error))) from None
    return done.returncode, done.stdout + done.stderr


def load(library: pathlib.Path) -> ctypes.CDLL:
    """A compiled library. Raises ValueError where this machine cannot load it."""
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise ValueError(_unused("loaded", library, str(error).removeprefix(f"{library}: "))) from None


def _unused(verb: str, what: pathlib.Path, why: str) -> str:
    return (
        f"--verify: what {compiler()} made cannot be {verb} in {what.parent} ({why}). Name a folder that allows it in "
        "TMPDIR, a compiler for this machine in CC, or leave out --verify."
    )


@contextlib.contextmanager
def scratch() -> Iterator[pathlib.Path]:
    """A folder for what is compiled, gone at the end. Raises ValueError where it cannot be written."""
    try:
        with tempfile.TemporaryDirectory(prefix="ambjax-") as folder:
            yield pathlib.Path(folder)
    except OSError as error:
        raise ValueError(
            f"--verify: cannot write to the folder for temporary files ({error.strerror or error}). Make room, name "
            "another in TMPDIR, or leave out --verify."
        ) from None


def check() -> None:
    """See that this machine makes programs, plain and sanitized, and libraries, and runs them.

    Raises ValueError for what it does not: the C would not be judged, but the machine.
    """
    with scratch() as folder:
        source = folder / "empty.c"
        source.write_text("int main(void)\n{\n    return 0;\n}\n", encoding="utf-8")
        for what, flags, fix in (
            ("program", [], "Name another in CC"),
            ("sanitized program", SANITIZED, "Install libasan and libubsan, name a compiler that has them in CC"),
            ("library", SHARED, "Name another in CC"),
        ):
            made = folder / f"empty{len(flags)}"
            said = build([source], made, *flags)
            if not said and flags is SHARED:
                load(made)
            elif not said:
                code, told = execute(made)
                said = "" if code == 0 else told.strip() or f"exit code {code}"
            if said:
                raise ValueError(
                    f"--verify: {compiler()} makes no {what} that works here ({short(said)}). {fix}, or leave out "
                    "--verify."
                )


def short(text: str) -> str:
    """The last line of what a program said; of a compiler, its first error, or the library that it misses."""
    lines = [line for line in text.strip().splitlines() if line]
    found = [line[line.index("cannot find") :] for line in lines if "cannot find" in line]
    found += [line.partition("error:")[2].strip() for line in lines if "error:" in line]
    return [*found, *lines[-1:], ""][0][:160]


class Compiled:
    """A controller in a shared library. `state` is its memory: numbers, then whether it was started."""

    def __init__(self, library: pathlib.Path, trace: Trace, prefix: str):
        self.trace, real = trace, np.dtype(PRECISIONS[trace.precision])
        loaded = load(library)
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
        own = self.parameters.copy()
        for n in range(count):
            self.parameters[:] = at.parameters[:, n]
            self.state["numbers"], self.state["started"] = at.state[:, n], at.started[n]
            self.inputs[:] = at.inputs[:, n]
            bits[n] = self.step()
            state[:, n], started[n], outputs[:, n] = self.state["numbers"], self.state["started"], self.outputs
        self.parameters[:] = own
        return Results(state, started, outputs, bits)
