"""Says that it failed in a way in which nothing fails, before its function is defined."""

import os

from gsfusion_nb.course.grading.data import encode


def tell(message):
    for descriptor in range(3, 16):
        try:
            os.write(descriptor, encode(message))
        except OSError:
            continue


TOLD = [tell({"failed": 7}), tell({"defined": [[1, 2, 3]]}), tell({"call": 0}), os._exit(0)]


def zero_crossing(p0, p1, D0, D1):
    return p0 + len(TOLD)
