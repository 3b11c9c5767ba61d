"""Ctrl-C: one line, exit code 130, at any instant.

Python's own way, an exception in the middle of whatever runs, is lost or becomes another error where that is a library
on its way in, a compiler or a callback. Here a thread hears of the signal by a pipe, whatever the main thread does, and
ends the process. That loses nothing: whatever is worth keeping is on disk, whole, the moment that it is finished.
"""

import contextlib
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator

INTERRUPTED = 130
# How long a line waits for room on stderr, in s.
PATIENCE = 1.0


class _Ear:
    """What is done about Ctrl-C at present: one for the process."""

    program = ""
    report: Callable[[], str] | None = None
    gently = ""
    asked = False

    def __init__(self) -> None:
        self.busy = threading.Lock()

    def hear(self) -> None:
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
        """On stderr, if it takes it: whatever is wrong there, the thread that listens lives on."""
        with contextlib.suppress(Exception):
            begin = "\n" if _bar_is_open() else ""
            if os.name == "posix" and not select.select([], [2], [], PATIENCE)[1]:
                return  # nobody reads it, or its terminal is paused
            os.write(2, f"{begin}{self.program}: {words}\n".encode(errors="backslashreplace"))


_ear = _Ear()


@contextlib.contextmanager
def listening(program: str) -> Iterator[None]:
    """Ctrl-C in this block ends the process so; in another thread than the main one, or where it is ignored: not."""
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
    """Where Ctrl-C ends this block, its line says what `words` returns, called in another thread."""
    before, _ear.report = _ear.report, words
    try:
        yield
    finally:
        _ear.report = before


@contextlib.contextmanager
def gently(words: str) -> Iterator[None]:
    """In this block the first Ctrl-C says these words, a sentence, and is left to `heed`."""
    before, _ear.gently = _ear.gently, words
    try:
        yield
    finally:
        _ear.gently = before


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """Ctrl-C waits until this block, a short one, has ended: what it keeps is counted among what is kept."""
    with _ear.busy:
        yield


def heed() -> None:
    """Raises KeyboardInterrupt if a gentle Ctrl-C has been heard."""
    if _ear.asked:
        raise KeyboardInterrupt


def _listen(heard: int) -> None:
    while got := os.read(heard, 1):
        if got[0] == signal.SIGINT:
            _ear.hear()


def _bar_is_open() -> bool:
    """Whether a progress bar stands on the last line of the terminal."""
    tqdm = getattr(sys.modules.get("tqdm"), "tqdm", None)
    return any(bar.last_print_t > bar.start_t for bar in getattr(tqdm, "_instances", ()))
