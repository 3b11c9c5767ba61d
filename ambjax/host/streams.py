"""Standard streams whose failure does not stop a run: always open, in any encoding, and silent after an error."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any


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
