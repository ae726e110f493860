"""A list in a list in a list ..."""


def zero_crossing(p0, p1, D0, D1):
    answer = []
    for _ in range(500):
        answer = [answer]
    return answer
