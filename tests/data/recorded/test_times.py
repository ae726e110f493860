"""Which numbers are times, and pairing by time."""

import pytest

from gsfusion_nb.data.recorded.times import associate, judge_stamps

CAMERA = [1305031102.17 + i / 30 for i in range(12)]


@pytest.mark.parametrize(
    ("numbers", "why"),
    [
        ([0.0058, 0.0070, 0.0154, 0.0148, 0.0163, 0.0331, 0.0057], "2 of 7 are smaller than the one before"),
        ([0.0331, 0.0333, 0.0329, 0.0334, 0.0330, 0.0335], "far closer together than the frames of a camera"),
        ([7.5] * 6, "all 6 are 7.5"),
        ([1.0, 1.0, 1.0, 2.0, 2.0, 2.0], "4 of 6 repeat another"),
        ([-0.1, 0.0, 0.1, 0.2], "1 of 4 are negative"),
        ([0.0, 1.0, 2.0, 3.0, 4.0], "they count the frames, from 0 to 4"),
        ([0.0, 5.0, 10.0, 20.0, 25.0, 30.0], "they count the frames"),
        ([*CAMERA[6:], *CAMERA[:6]], "1 of 12 are smaller than the one before"),
        ([0.05, 0.21, 0.12, 0.30, 0.08, 0.17], "2 of 6 are smaller than the one before"),
    ],
)
def test_numbers_that_are_no_times(numbers, why):
    found = judge_stamps(numbers)
    assert found.times_s is None
    assert why in found.why_not


@pytest.mark.parametrize(("unit", "per_s"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("start", [0.0, 1305031102.25])
def test_the_unit_is_found(unit, per_s, start):
    times = [start + i / 30 for i in range(8)]
    found = judge_stamps([t * per_s for t in times])
    assert found.unit == unit
    assert found.times_s == pytest.approx(times, abs=1e-6)


def test_names_may_confirm_another_order_than_the_list():
    shuffled = [CAMERA[3], *CAMERA[:3], *CAMERA[4:]]
    found = judge_stamps(shuffled, names=[f"{t:.6f}" for t in shuffled])
    assert found.times_s == shuffled
    assert found.unordered == 1
    assert judge_stamps(shuffled, names=[f"{i:06d}" for i in range(12)]).times_s is None


def test_nearest_within_the_limit():
    assert associate([0.0, 1.0, 2.0], [0.01, 1.03, 1.99]) == [(0, 0), (2, 2)]
    assert associate([0.0, 1.0, 2.0], [0.01, 1.03, 1.99], max_difference_s=0.05) == [(0, 0), (1, 1), (2, 2)]


def test_each_entry_is_used_once_and_the_best_pair_wins():
    # both want entry 0; the second is nearer, so the first takes what is left
    assert associate([0.000, 0.012], [0.010, 0.019], max_difference_s=0.02) == [(0, 1), (1, 0)]
    assert associate([0.000, 0.012], [0.010], max_difference_s=0.02) == [(1, 0)]


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
