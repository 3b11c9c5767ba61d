"""Handling of Ctrl-C: the process prints one line and ends with exit code 130, at any instant.

Python raises KeyboardInterrupt in the code that happens to run. During an import, a compilation or a callback that
exception is lost, or becomes another error. Here a thread reads the signal from a pipe, independently of the main
thread, and ends the process. Finished results are not lost, because each is written atomically when it is finished.
"""

import contextlib
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator

INTERRUPTED = 130
# Longest time to wait until stderr accepts a line, s.
PATIENCE = 1.0


class _Ear:
    """Current response of the process to Ctrl-C. There is one instance.

    - `program`: name of the program, the prefix of messages.
    - `report`: returns the words that follow "interrupted"; None: no words.
    - `gently`: message for the first Ctrl-C, which then does not end the process; empty: the first one ends it.
    - `asked`: whether that first Ctrl-C was received.
    - `busy`: lock that delays the end of the process.
    """

    program = ""
    report: Callable[[], str] | None = None
    gently = ""
    asked = False

    def __init__(self) -> None:
        self.busy = threading.Lock()

    def hear(self) -> None:
        """Respond to one Ctrl-C: print the message of `gently` once; otherwise report and end the process."""
        if self.gently and not self.asked:
            self.asked = True
            self._say(f"{self.gently} Ctrl-C again ends it at once.")
            return
        with self.busy:
            try:
                words = self.report() if self.report is not None else ""
                self._say(f"interrupted{f': {words}' if words else ''}.")
            except Exception as error:  # the report's
                self._say(f"interrupted; what is kept is not known ({type(error).__name__}).")
            finally:
                os._exit(INTERRUPTED)

    def _say(self, words: str) -> None:
        """Write a line to stderr. Suppresses every error, because the listening thread must continue."""
        with contextlib.suppress(Exception):
            begin = "\n" if _bar_is_open() else ""
            if os.name == "posix" and not select.select([], [2], [], PATIENCE)[1]:
                return  # a full pipe, or a paused terminal
            os.write(2, f"{begin}{self.program}: {words}\n".encode(errors="backslashreplace"))


_ear = _Ear()


@contextlib.contextmanager
def listening(program: str) -> Iterator[None]:
    """Handle Ctrl-C in this block as the module describes.

    Has no effect outside the main thread, or if SIGINT is ignored.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, None):
        yield
        return
    read_end, write_end = os.pipe()
    if os.name == "posix":
        os.set_blocking(write_end, False)
    _ear.program, _ear.asked = program, False
    before = signal.signal(signal.SIGINT, lambda *_: None), signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    thread = threading.Thread(target=_listen, args=(read_end,), daemon=True)
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
def keeping(words: Callable[[], str]) -> Iterator[None]:
    """Report the result of `words()` if Ctrl-C ends the process in this block. Another thread calls `words`."""
    before, _ear.report = _ear.report, words
    try:
        yield
    finally:
        _ear.report = before


@contextlib.contextmanager
def gently(words: str) -> Iterator[None]:
    """At the first Ctrl-C in this block, print the sentence `words` and let `heed` raise. A second ends the process."""
    before, _ear.gently = _ear.gently, words
    try:
        yield
    finally:
        _ear.gently = before


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """Delay Ctrl-C until this block ends, so that its result is included in the report. The block must be short."""
    with _ear.busy:
        yield


def heed() -> None:
    """Raise KeyboardInterrupt if a first Ctrl-C was received in a `gently` block."""
    if _ear.asked:
        raise KeyboardInterrupt


def _listen(heard: int) -> None:
    while got := os.read(heard, 1):
        if got[0] == signal.SIGINT:
            _ear.hear()


def _bar_is_open() -> bool:
    """Return whether the last line of the terminal shows a progress bar."""
    tqdm = getattr(sys.modules.get("tqdm"), "tqdm", None)
    return any(bar.last_print_t > bar.start_t for bar in getattr(tqdm, "_instances", ()))
