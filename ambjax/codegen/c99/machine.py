"""The C compiler of this machine, and the Python interface of a compiled block."""

import contextlib
import ctypes
import functools
import os
import pathlib
import shutil
import subprocess
import tempfile
from collections.abc import Iterator

import numpy as np

from ambjax.codegen.points import Points, Results
from ambjax.codegen.program import PRECISIONS
from ambjax.codegen.trace import Trace

STRICT = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic", "-Werror"]
EXACT = "-ffp-contract=off"
SANITIZED = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
SHARED = ["-shared", "-fPIC"]
# For messages: the option that needs a compiler, and what to do without one.
VERIFY, FMU = ("--verify", "omit --verify"), ("--format fmu", "use --format c")
# Time limit of a compiled program, s.
TIME_LIMIT = 60
_run = functools.partial(subprocess.run, capture_output=True, text=True, errors="replace", check=False)


def compiler(asked: tuple[str, str] = VERIFY) -> str:
    """Return the C compiler: $CC if it is set, else the first of cc, gcc and clang that exists.

    Raises ValueError if there is none. `asked`: the option that needs a compiler and another fix, for the message.
    """
    requested = os.environ.get("CC")
    for name in [requested] if requested else ["cc", "gcc", "clang"]:
        if found := shutil.which(name):
            return found
    missing = f"there is no C compiler ({requested or 'cc, gcc or clang'})"
    raise ValueError(f"{asked[0]}: {missing}. Install one, set CC, or {asked[1]}.")


def build(sources: list[pathlib.Path], target: pathlib.Path, *flags: str, asked: tuple[str, str] = VERIFY) -> str:
    """Compile `sources` to `target` with STRICT, EXACT and `flags`. `asked`: as for `compiler`."""
    command = [compiler(asked), *STRICT, EXACT, *flags, *map(str, sources), "-o", str(target), "-lm"]
    try:
        done = _run(command)
    except OSError as error:
        why = f"the C compiler {command[0]} cannot be run ({error.strerror})"
        raise ValueError(f"{asked[0]}: {why}. Set CC to another, or {asked[1]}.") from None
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit code {done.returncode}"


def execute(program: pathlib.Path) -> tuple[int, str]:
    """Run a compiled program, and return its exit code and its output."""
    try:
        done = _run([program], timeout=TIME_LIMIT)
    except subprocess.TimeoutExpired:
        raise ValueError(
            f"--verify: the program {program.name} did not end within {TIME_LIMIT:g} s, so the check is not decided. "
            "Try again when the machine is less busy, or omit --verify."
        ) from None
    except OSError as error:
        raise ValueError(_unusable("run", program, error.strerror or str(error))) from None
    return done.returncode, done.stdout + done.stderr


def load_library(library: pathlib.Path) -> ctypes.CDLL:
    """Load a compiled library. Raises ValueError if this machine cannot load it."""
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise ValueError(_unusable("loaded", library, str(error).removeprefix(f"{library}: "))) from None


def _unusable(verb: str, what: pathlib.Path, why: str) -> str:
    return (
        f"--verify: the output of {compiler()} cannot be {verb} in {what.parent} ({why}). Set TMPDIR to a folder that "
        "allows it, set CC to a compiler for this machine, or omit --verify."
    )


@contextlib.contextmanager
def scratch() -> Iterator[pathlib.Path]:
    """Yield a temporary folder for compilation. Raises ValueError if it cannot be written."""
    try:
        with tempfile.TemporaryDirectory(prefix="ambjax-") as folder:
            yield pathlib.Path(folder)
    except OSError as error:
        raise ValueError(
            f"cannot write to the folder for temporary files ({error.strerror or error}). Free space, or set TMPDIR to "
            "another folder."
        ) from None


def check_compiler() -> None:
    """Check that this machine can compile and run programs, plain and sanitized, and compile and load libraries."""
    with scratch() as folder:
        source = folder / "empty.c"
        source.write_text("int main(void)\n{\n    return 0;\n}\n", encoding="utf-8")
        for what, flags, fix in (
            ("program", [], "Set CC to another compiler"),
            ("sanitized program", SANITIZED, "Install libasan and libubsan, set CC to a compiler that has them"),
            ("library", SHARED, "Set CC to another compiler"),
        ):
            binary = folder / f"empty{len(flags)}"
            messages = build([source], binary, *flags)
            if not messages and flags is SHARED:
                load_library(binary)
            elif not messages:
                code, output = execute(binary)
                messages = "" if code == 0 else output.strip() or f"exit code {code}"
            if messages:
                raise ValueError(
                    f"--verify: {compiler()} cannot make a {what} that works ({short(messages)}). {fix}, or omit "
                    "--verify."
                )


def short(text: str) -> str:
    """Return at most 160 characters: a missing library, else the first error, else the last line of the output."""
    lines = [line for line in text.strip().splitlines() if line]
    found = [line[line.index("cannot find") :] for line in lines if "cannot find" in line]
    found += [line.partition("error:")[2].strip() for line in lines if "error:" in line]
    return [*found, *lines[-1:], ""][0][:160]


class Compiled:
    """The Python interface of a block in a shared library.

    `library`: the compiled C of `trace`, whose names begin with `prefix`. `parameters`, `state`, `inputs` and `outputs`
    are the arrays that the C reads and writes; `state` consists of "numbers" and the flag "started".
    """

    def __init__(self, library: pathlib.Path, trace: Trace, prefix: str) -> None:
        self.trace, real = trace, np.dtype(PRECISIONS[trace.precision])
        loaded = load_library(library)
        self._step = getattr(loaded, f"{prefix}_step")
        self._step.restype = ctypes.c_uint32
        self.memory = np.dtype([("numbers", real, (len(trace.state),)), ("started", np.uint32)], align=True)
        count = len(trace.parameters)
        default = (ctypes.c_char * (count * real.itemsize)).in_dll(loaded, f"{prefix}_default")
        self.parameters = np.frombuffer(bytes(default), real).copy()
        self.state = np.zeros((), self.memory)
        self.inputs, self.outputs = np.zeros(len(trace.inputs), real), np.zeros(len(trace.outputs), real)
        self._at = [x.ctypes.data_as(ctypes.c_void_p) for x in (self.parameters, self.state, self.inputs, self.outputs)]
        self._library = loaded

    def step(self) -> int:
        """Compute one sample from `inputs`, update `state` and `outputs`, and return the status bits."""
        return self._step(*self._at)

    def results(self, at: Points) -> Results:
        """Return the results of one step from each point. Only `parameters` is restored afterwards."""
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
