"""Standard streams that are never in the way of the work: open, of any alphabet, and silent once they take nothing."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any


class Lenient:
    """A text stream that keeps its first failure, after which what is written goes nowhere. Else it is the stream."""

    def __init__(self, stream: Any):
        self.stream, self.failed = stream, None

    def write(self, text: str) -> int:
        self._try(lambda: self.stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._try(self.stream.flush)

    def failure(self) -> Exception | None:
        """Why something that was written has not arrived; None: all of it has."""
        self.flush()
        return self.failed

    def _try(self, act: Callable[[], Any]) -> None:
        if self.failed is None:
            try:
                act()
            except (OSError, ValueError) as why:  # ValueError: it is closed
                self.failed = why

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def open_streams() -> None:
    """Give streams that the caller has closed an end: print would put on stdout what is meant for a missing stderr.

    In the order of their numbers, so that no file that is opened later takes the place of one. What the alphabet of
    stdout or stderr lacks is written as an escape.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115, PTH123
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]


@contextlib.contextmanager
def lenient() -> Iterator[Lenient]:
    """stdout, which is yielded, and stderr are lenient in this block.

    One that failed stays so: what it holds would fail once more as Python ends, and become the exit code.
    """
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
