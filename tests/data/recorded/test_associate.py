"""Pairing by time."""

from gsfusion_nb.data.recorded.times import associate


def test_nearest_within_the_limit():
    assert associate([0.0, 1.0, 2.0], [0.01, 1.03, 1.99]) == [(0, 0), (2, 2)]
    assert associate([0.0, 1.0, 2.0], [0.01, 1.03, 1.99], max_difference_s=0.05) == [(0, 0), (1, 1), (2, 2)]


def test_each_entry_is_used_once_and_the_best_pair_wins():
    # both want entry 0; the second is nearer, so the first takes what is left
    assert associate([0.000, 0.012], [0.010, 0.019], max_difference_s=0.02) == [(0, 1), (1, 0)]
    assert associate([0.000, 0.012], [0.010], max_difference_s=0.02) == [(1, 0)]


def test_any_order_and_empty():
    assert associate([2.0, 0.0, 1.0], [1.0, 2.0, 0.0]) == [(1, 2), (2, 0), (0, 1)]
    assert associate([], [1.0]) == []
    assert associate([1.0], []) == []


def test_against_exhaustive_search():
    first = [0.033 * i + 0.004 * ((7 * i) % 5) for i in range(60)]
    second = [0.0335 * i + 0.003 * ((11 * i) % 7) for i in range(60)]
    pairs = associate(first, second)
    left = {(i, j): abs(a - b) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) <= 0.02}
    expected = []
    while left:
        i, j = min(left, key=lambda pair: (left[pair], pair))
        expected.append((i, j))
        left = {p: d for p, d in left.items() if p[0] != i and p[1] != j}
    assert pairs == sorted(expected)
    assert len(pairs) > 40
