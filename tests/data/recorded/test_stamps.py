"""Which numbers are times."""

import pytest

from gsfusion_nb.data.recorded.times import judge_stamps

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
        ([*CAMERA[:6], *(1000 * t for t in CAMERA[6:])], "they are in several units"),
        ([0.1, 0.133, 0.166, 0.2, 233.0, 266.0, 300.0, 333.0], "they are in several units"),
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


def test_a_file_of_seconds_may_hold_whole_seconds():
    assert judge_stamps([0.0, 1.0, 2.0, 3.0], unit="s").times_s == [0, 1, 2, 3]
