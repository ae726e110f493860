"""An error of 100 MB."""


def zero_crossing(p0, p1, D0, D1):
    raise ValueError("x" * 100_000_000)
