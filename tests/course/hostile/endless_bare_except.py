"""A loop that no exception leaves."""


def zero_crossing(p0, p1, D0, D1):
    while True:
        try:
            while True:
                pass
        except:
            pass
