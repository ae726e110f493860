"""Stops its process, which does not end."""

import os
import signal


def zero_crossing(p0, p1, D0, D1):
    os.kill(os.getpid(), signal.SIGSTOP)
    return p0
