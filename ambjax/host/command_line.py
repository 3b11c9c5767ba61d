"""Command lines: arguments, errors on one line, a summary as JSON, exit codes, streams whose failure stops no run."""

import argparse
import atexit
import contextlib
import difflib
import errno
import gc
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NoReturn

from ambjax.text.words import one_line

# Errors of a file system that another folder or free space may resolve.
UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO)
# Thresholds of the garbage collector. Imports and tracing allocate millions of objects that live until the end of a
# command. With Python's own thresholds, the collector scans them again and again.
GC_THRESHOLDS = (100_000, 20, 20)


class Parser(argparse.ArgumentParser):
    """Argument parser that prints an error on one line and exits with code 2.

    `commands`: the parsers of the commands by name.
    """

    commands: Mapping[str, argparse.ArgumentParser] = MappingProxyType({})

    def error(self, message: str) -> NoReturn:
        end = "" if message.endswith("?") else "."
        sys.exit(complain(f"{message}{end} See '{self.prog} --help'.", self.prog.split()[0]))

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Parse the arguments. For an unknown command or option, the error names a similar one, if there is one."""
        words = list(sys.argv[1:] if args is None else args)
        if self.commands and words and not words[0].startswith("-") and words[0] not in self.commands:
            known = f"It must be one of {', '.join(self.commands)}"
            self.error(f"{words[0]!r} is not a command. {known}.{_similar(words[0], self.commands)}".rstrip("."))
        parsed, unknown = self.parse_known_args(words, namespace)
        if unknown:
            used = self.commands.get(getattr(parsed, "command", ""), self)
            options = re.findall(r"--[a-z-]+", used.format_usage())
            used.error(f"unrecognized arguments: {' '.join(unknown)}.{_similar(unknown[0], options)}".rstrip("."))
        return parsed


def _similar(word: str, names: Iterable[str]) -> str:
    """Return ' Did you mean NAME?' with the most similar name, or ''."""
    close = difflib.get_close_matches(word.partition("=")[0], list(names), n=1, cutoff=0.75)
    return f" Did you mean {close[0]!r}?" if close else ""


def complain(message: str, program: str = "ambjax") -> int:
    """Print an error message on one line of stderr and return exit code 2. A failure of stderr is ignored."""
    with contextlib.suppress(OSError):
        print(one_line(f"{program}: {message}"), file=sys.stderr)
    return 2


Run = Callable[[argparse.Namespace], tuple[int, object]]


def run_command(parser: argparse.ArgumentParser, words: list[str] | None, run: Run) -> int:
    """Parse the arguments `words`, call `run`, print its summary if --json is given, and return the exit code.

    `run` returns an exit code and a summary. An error is printed on one line of stderr. The command continues if stdout
    cannot be written. A closed pipe (`| head`) is not an error; any other failure of stdout gives exit code 2. Raises
    SystemExit for --help, --version and wrong arguments, as argparse does.
    """
    if not sys.warnoptions:  # warnings of libraries are for developers: `python -W default -m ambjax` prints them
        logging.captureWarnings(True)
        # XLA's own messages, such as that on a slow compilation; JAX raises errors
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # the matrices of NumPy and SciPy are small here, and threads wait for each other on a busy machine
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(*GC_THRESHOLDS)
    atexit.register(gc.freeze)  # without this, the collector would scan all objects once more at exit
    with lenient() as stdout:
        try:
            args = parser.parse_args(words)
        except SystemExit as end:  # wrong arguments, or the output of --help and --version
            if end.code or stdout.failure() is None:
                raise
            code = 0
        else:
            code = _code(lambda: run(args), getattr(args, "json", False), parser.prog)
        failure = stdout.failure()
        if failure is None or isinstance(failure, BrokenPipeError):
            return code
        why = getattr(failure, "strerror", None) or failure
        return complain(f"cannot write to stdout: {why}. Free disk space, or redirect the output.", parser.prog)


def _code(run: Callable[[], tuple[int, object]], as_json: bool, program: str) -> int:
    try:
        code, summary = run()
        if as_json:
            print(json.dumps(summary, indent=2))
    except KeyboardInterrupt as stop:
        complain(f"interrupted{f': {stop}' if str(stop) else ''}.", program)
        return 130
    except Exception as error:
        return complain(message(error), program)
    return code


def message(error: Exception) -> str:
    """Return the message of an error that a user can correct. Raise any other error again: it is a bug of ambjax."""
    match error:
        case ValueError():
            return str(error)
        case OSError():
            where = f"{error.filename}: " if error.filename else ""
            fix = " Free disk space, or write elsewhere." if error.errno in UNWRITABLE else ""
            return f"{where}{error.strerror or error}.{fix}"
        case MemoryError():
            return "not enough memory. Use fewer members or samples."
        case RuntimeError() if not isinstance(error, (NotImplementedError, RecursionError)):
            # JAX: a device is missing, or its memory is full
            return str(error).strip().partition("\n")[0] or type(error).__name__
    raise error


class Lenient:
    """A wrapper of a text stream that records the first failure and discards all text after it."""

    def __init__(self, stream: Any) -> None:
        self.stream, self.failed = stream, None

    def write(self, text: str) -> int:
        self._try(lambda: self.stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._try(self.stream.flush)

    def failure(self) -> Exception | None:
        """Flush, and return the first failure; None if all text was written."""
        self.flush()
        return self.failed

    def _try(self, act: Callable[[], object]) -> None:
        if self.failed is None:
            try:
                act()
            except (OSError, ValueError) as why:  # ValueError: the stream is closed
                self.failed = why

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def open_streams() -> None:
    """Open the null device for each standard stream that was closed when the process started.

    Streams are opened in the order of their file numbers, so that no later file takes the number of a standard stream.
    Characters that the encoding of stdout or stderr lacks are written as escapes.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115, PTH123
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]


@contextlib.contextmanager
def lenient() -> Iterator[Lenient]:
    """Wrap stdout and stderr in `Lenient` for this block, and yield the wrapper of stdout."""
    before = {name: getattr(sys, name) for name in ("stdout", "stderr")}
    now = {name: Lenient(stream) for name, stream in before.items()}
    for name, stream in now.items():
        setattr(sys, name, stream)
    try:
        yield now["stdout"]
    finally:
        for name, stream in now.items():
            if stream.failure() is None:
                setattr(sys, name, before[name])
