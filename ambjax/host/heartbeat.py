"""Lines on stderr that say what takes long, so that no command is silent for more than five seconds."""

import contextlib
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from typing import Self

from ambjax.host.interrupts import bar_is_open
from ambjax.text.words import one_line

# A heartbeat repeats its text after SILENCE seconds without a line.
SILENCE = 4.5
# Part of a text about simulations: why the first one takes longer.
FIRST_RUN = "the first run compiles a program, which can take a minute"
# The heartbeats that run, the last one entered at the end.
_running: list["Heartbeat"] = []
# One entry for each open `quiet`.
_quiet: list[bool] = []


class Heartbeat:
    """Context manager that writes its text to stderr again and again while nothing else is written there.

    Each line begins with the time since the beginning. On a terminal, such repetitions overwrite each other. Of several
    that run, only the last one entered writes.
    """

    lock = threading.RLock()  # of all heartbeats, because each line closes those of the others

    def __init__(self) -> None:
        self.began = self.written = time.monotonic()
        self.text, self.open = "", False
        self.ended = threading.Event()

    def __enter__(self) -> Self:
        _running.append(self)
        threading.Thread(target=self._repeat, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        for heartbeat in _running:
            heartbeat.close()
        _running.remove(self)

    def _repeat(self) -> None:
        while not self.ended.wait(SILENCE / 9):
            with self.lock:
                inner = _running[-1:] == [self]  # the line of a command inside this one tells more
                if inner and self.text and time.monotonic() - self.written >= SILENCE and not bar_is_open():
                    self.line(f"... {self.text}", passing=True)

    def line(self, text: str, *, passing: bool = False) -> None:
        """Write a line. On a terminal, the next line overwrites it if `passing`."""
        minutes, seconds = divmod(int(time.monotonic() - self.began), 60)
        stamped = f"{minutes}:{seconds:02d} {text}"
        with self.lock:
            if passing and sys.stderr.isatty():
                self._rewrite(stamped[: shutil.get_terminal_size().columns - 1])
                self.written, self.open = time.monotonic(), True
            else:
                self.close()
                _print(stamped)

    def close(self) -> None:
        """Remove a line that the next one overwrites."""
        with self.lock:
            if self.open:
                self._rewrite("")
            self.written, self.open = time.monotonic(), False

    def _rewrite(self, text: str) -> None:
        """Replace the last line of the terminal. A failure of stderr is ignored."""
        with contextlib.suppress(OSError, ValueError):
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Print no remarks in the block: for functions of Python that the commands share. A running heartbeat goes on."""
    _quiet.append(True)
    try:
        yield
    finally:
        _quiet.pop()


def is_quiet() -> bool:
    """Return whether remarks are not printed."""
    return bool(_quiet)


def say(text: str) -> None:
    """Print a remark on one line of stderr; stdout carries the results only. A failure of stderr is ignored."""
    if is_quiet():
        return
    for heartbeat in _running:
        heartbeat.close()
        if heartbeat.text:
            heartbeat.text = f"{text}; {FIRST_RUN}" if FIRST_RUN in heartbeat.text else text
    _print(text)


def _print(text: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        print(one_line(text), file=sys.stderr, flush=True)


@contextlib.contextmanager
def doing(text: str) -> Iterator[None]:
    """Let the heartbeat of the command, if it has one, say `text` while the block takes long."""
    if not _running:
        yield
        return
    heartbeat = _running[-1]
    before, heartbeat.text = heartbeat.text, text
    try:
        yield
    finally:
        heartbeat.text = before
        if heartbeat.open:
            heartbeat.close()
