"""Standard streams whose failures do not stop a command: closed streams, missing characters, and write errors."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any


class Lenient:
    """Wrapper of a text stream that records the first failure and then discards all output.

    All other attributes are those of the stream.
    """

    def __init__(self, stream: Any):
        self.stream, self.failed = stream, None

    def write(self, text: str) -> int:
        self._try(lambda: self.stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._try(self.stream.flush)

    def failure(self) -> Exception | None:
        """Flush the stream and return its first failure; None if all output was written."""
        self.flush()
        return self.failed

    def _try(self, act: Callable[[], Any]) -> None:
        if self.failed is None:
            try:
                act()
            except (OSError, ValueError) as why:  # ValueError: the stream is closed
                self.failed = why

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def open_streams() -> None:
    """Open closed standard streams on the null device, and escape characters that stdout or stderr cannot encode.

    Without stderr, `print` would write messages for stderr to stdout. The streams are opened in the order of their file
    descriptors, so that no file opened later gets the descriptor of a standard stream.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115, PTH123
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]


@contextlib.contextmanager
def lenient() -> Iterator[Lenient]:
    """Wrap stdout and stderr in `Lenient` in this block, and yield the wrapped stdout.

    A stream that failed stays wrapped. Otherwise its buffer would fail again when Python exits, and change the exit
    code.
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
