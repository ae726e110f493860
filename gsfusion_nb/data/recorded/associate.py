"""Pairing two streams by time."""

import bisect


def associate(first_s: list[float], second_s: list[float], *, max_difference_s: float = 0.02) -> list[tuple[int, int]]:
    """Pairs (i, j) of the entries of two streams that are nearest in time, each entry used at most once.

    Candidates are taken in order of their time difference, so a worse pair never uses an entry of a better one (Sturm
    et al. 2012, the association of the TUM RGB-D benchmark).

    Args:
        first_s: Times of the first stream, seconds, any order.
        second_s: Times of the second stream, seconds, any order.
        max_difference_s: Largest difference of a pair, seconds.

    Returns:
        Pairs of positions, ordered by the time of the first stream.
    """
    order = sorted(range(len(second_s)), key=second_s.__getitem__)
    times = [second_s[j] for j in order]
    candidates = []
    for i, t in enumerate(first_s):
        k = bisect.bisect_left(
            times, t - 2 * max_difference_s
        )  # a little wider, so that rounding excludes no candidate
        while k < len(times) and times[k] <= t + 2 * max_difference_s:
            if abs(times[k] - t) <= max_difference_s:
                candidates.append((abs(times[k] - t), i, order[k]))
            k += 1
    pairs: dict[int, int] = {}
    used: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in pairs and j not in used:
            pairs[i] = j
            used.add(j)
    return sorted(pairs.items(), key=lambda pair: first_s[pair[0]])
