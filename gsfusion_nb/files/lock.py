"""A lock on an open file, which ends with the process that holds it."""

import errno
import sys


def try_lock(handle: int) -> bool:
    """Lock an open file for this process; whether no other one holds it.

    The operating system frees the lock when the file is closed or its holder ends, however it ends.
    A file system that has no locks keeps nobody out.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as e:
        return e.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
    return True
