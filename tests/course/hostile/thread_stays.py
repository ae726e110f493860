"""Right, and leaves a thread that never ends."""

import threading


def forever():
    while True:
        pass


def zero_crossing(p0, p1, D0, D1):
    threading.Thread(target=forever).start()
    t = D0 / (D0 - D1)
    return p0 + t[:, None] * (p1 - p0)
