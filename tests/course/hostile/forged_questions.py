"""Asks the judge without end, and never hears what it answers."""

import os

from gsfusion_nb.course.grading.data import encode

QUESTION = encode({"reference": "zero_crossing", "args": [], "kwargs": {}}) * 1000


def zero_crossing(p0, p1, D0, D1):
    while True:
        for descriptor in range(3, 16):
            try:
                os.write(descriptor, QUESTION)
            except OSError:
                continue
