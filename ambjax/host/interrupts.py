"""Ctrl-C handling: print one line on stderr and exit with code 130, at any instant.

Python's default raises KeyboardInterrupt in the main thread. A library that is being imported, a compiler or a callback
can swallow that exception or replace it. Here the signal writes to a pipe, and a thread that reads the pipe ends the
process. No finished work is lost, because every result is written to disk, complete, as soon as it is finished.
"""

import contextlib
import os
import pathlib
import select
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator

INTERRUPTED = 130
# Time for which a message waits until stderr accepts it, s.
STDERR_TIMEOUT = 1.0


class _Handler:
    """The current reaction to Ctrl-C. There is one instance per process."""

    program = ""
    report: Callable[[], str] | None = None
    deferral = ""
    pending = False
    unfinished: pathlib.Path | None = None

    def __init__(self) -> None:
        self.busy = threading.Lock()

    def handle(self) -> None:
        """Record the first Ctrl-C of a `deferred` block; end the process on any other."""
        if self.deferral and not self.pending:
            self.pending = True
            self._print(f"{self.deferral} Ctrl-C again ends it at once.")
            return
        with self.busy:
            try:
                words = self.report() if self.report is not None else ""
                self._print(f"interrupted{f': {words}' if words else ''}.")
            except Exception as error:  # raised by the report
                self._print(f"interrupted; it is not known which results are kept ({type(error).__name__}).")
            finally:
                if self.unfinished is not None:
                    shutil.rmtree(self.unfinished, ignore_errors=True)
                    with contextlib.suppress(OSError):
                        self.unfinished.parent.rmdir()
                os._exit(INTERRUPTED)

    def _print(self, words: str) -> None:
        """Write a line to stderr. A failure to write must not end the thread."""
        with contextlib.suppress(Exception):
            begin = "\n" if bar_is_open() else ""
            if os.name == "posix" and not select.select([], [2], [], STDERR_TIMEOUT)[1]:
                return  # the reader is gone, or the terminal is paused
            os.write(2, f"{begin}{self.program}: {words}\n".encode(errors="backslashreplace"))


_handler = _Handler()


@contextlib.contextmanager
def exit_on_interrupt(program: str) -> Iterator[None]:
    """End the process on Ctrl-C in this block, with a message that begins with `program`.

    Has no effect outside the main thread, or where SIGINT is ignored.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, None):
        yield
        return
    read_end, write_end = os.pipe()
    if os.name == "posix":
        os.set_blocking(write_end, False)
    _handler.program, _handler.pending = program, False
    # Python's tracker of semaphores, a process, outlives this one, and would warn of those of the worker processes
    sys.warnoptions.append("ignore:resource_tracker:UserWarning")
    before = signal.signal(signal.SIGINT, lambda *_: None), signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    thread = threading.Thread(target=_read_signals, args=(read_end,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before[1])
        signal.signal(signal.SIGINT, before[0])
        os.close(write_end)
        thread.join()
        os.close(read_end)


@contextlib.contextmanager
def _during(name: str, value: object) -> Iterator[None]:
    """Give an attribute of the handler another value in this block."""
    before = getattr(_handler, name)
    setattr(_handler, name, value)
    try:
        yield
    finally:
        setattr(_handler, name, before)


def reporting(words: Callable[[], str]) -> contextlib.AbstractContextManager[None]:
    """Add the text that `words` returns to the message of a Ctrl-C in this block. Another thread calls `words`.

    In a nested block, the words of the outer one apply.
    """
    return _during("report", _handler.report or words)


def deferred(words: str) -> contextlib.AbstractContextManager[None]:
    """Print `words`, a sentence, on the first Ctrl-C in this block, and leave the exit to `raise_if_interrupted`.

    Has no effect if `words` is empty. A second Ctrl-C ends the process.
    """
    return _during("deferral", words)


def uninterrupted() -> contextlib.AbstractContextManager[object]:
    """Delay Ctrl-C until the end of this short block, so that the report includes the files written in it."""
    return _handler.busy


def removed_by_interrupt(folder: pathlib.Path) -> contextlib.AbstractContextManager[None]:
    """Remove `folder`, and its parent if that is then empty, if a Ctrl-C ends the process in this block."""
    return _during("unfinished", folder)


def raise_if_interrupted() -> None:
    """Raise KeyboardInterrupt if a `deferred` block has received Ctrl-C."""
    if _handler.pending:
        raise KeyboardInterrupt


def _read_signals(read_end: int) -> None:
    while received := os.read(read_end, 1):
        if received[0] == signal.SIGINT:
            _handler.handle()


def bar_is_open() -> bool:
    """Return whether the last line of the terminal shows a progress bar."""
    tqdm = getattr(sys.modules.get("tqdm"), "tqdm", None)
    return any(bar.last_print_t > bar.start_t for bar in getattr(tqdm, "_instances", ()))
