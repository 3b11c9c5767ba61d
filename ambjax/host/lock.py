"""A lock on a directory, for one process at a time. The system releases it when the process ends."""

import contextlib
import errno
import pathlib
from collections.abc import Iterator

from filelock import FileLock, Timeout

LOCK = ".ambjax-lock"
# Error codes of a file system without locks.
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextlib.contextmanager
def locked(directory: pathlib.Path) -> Iterator[None]:
    """Hold the lock on the directory in this block.

    Has no effect on a file system without locks. Raises ValueError if another process holds the lock, and OSError if
    the lock file cannot be created.
    """
    lock = FileLock(directory / LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        advice = "Wait for it, or choose another directory."
        raise ValueError(f"--out {directory}: another run is using this directory. {advice}") from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            (directory / LOCK).unlink()
        lock.release()
