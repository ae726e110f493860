"""Sends a message that is no dictionary, and one whose parts are of other types."""

import os

from gsfusion_nb.course.grading.data import encode

MESSAGES = [
    {"value": 0, "changes": 3, "callees": [], "borrowed": [[]]},
    [1, 2, 3],
]


def zero_crossing(p0, p1, D0, D1):
    for message in MESSAGES:
        for descriptor in range(3, 16):
            try:
                os.write(descriptor, encode(message))
            except OSError:
                continue
    return p0
