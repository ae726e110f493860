"""Never gets to the function."""

import time

SECONDS = time.sleep(1e6)


def zero_crossing(p0, p1, D0, D1):
    return p0 + SECONDS
