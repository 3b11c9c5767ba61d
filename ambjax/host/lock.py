"""One process at a time in a directory: by a lock that the system lifts when its holder ends, however that ends."""

import contextlib
import os
import pathlib
from collections.abc import Iterator

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = ".ambjax-lock"


@contextlib.contextmanager
def alone(directory: pathlib.Path) -> Iterator[None]:
    """Hold the directory in this block. Raises ValueError if another process does, OSError where none can.

    Without effect where the system, or the file system, has no such locks.
    """
    path = directory / LOCK
    held = _held(path)
    try:
        yield
    finally:
        if held is not None:
            with contextlib.suppress(OSError):
                path.unlink()
            os.close(held)


def _held(path: pathlib.Path) -> int | None:
    """The lock's file, open; None: there are no locks."""
    while fcntl is not None:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.lexists(path) and os.path.samestat(os.fstat(file), path.lstat()):
                return file  # not one that its last holder has just removed
        except BlockingIOError:
            os.close(file)
            raise ValueError(
                f"--out {path.parent}: another run is at work there. Wait for it, or choose another directory."
            ) from None
        except OSError:
            os.close(file)
            return None
        os.close(file)
    return None
