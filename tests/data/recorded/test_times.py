"""Which numbers are times, and pairing by time."""

import re
from pathlib import Path

import pytest

from gsfusion_nb.data import SequenceError
from gsfusion_nb.data.recorded.files import natural_order
from gsfusion_nb.data.recorded.stamps import common_unit, judge_stamps, time_unit
from gsfusion_nb.data.recorded.time_doubts import doubt_on_times
from gsfusion_nb.data.recorded.times import associate, read_image_list, times_of_images

CAMERA = [1305031102.17 + i / 30 for i in range(12)]


@pytest.mark.parametrize(
    ("numbers", "why"),
    [
        (
            [0.0058, 0.0070, 0.0154, 0.0148, 0.0163, 0.0331, 0.0057],
            "2 of 7 are smaller than the one before",
        ),
        (
            [0.0331, 0.0333, 0.0329, 0.0334, 0.0330, 0.0335],
            "far closer together than the frames of a camera",
        ),
        ([7.5] * 6, "all 6 are 7.5"),
        ([1.0, 1.0, 1.0, 2.0, 2.0, 2.0], "4 of 6 repeat another"),
        ([-0.1, 0.0, 0.1, 0.2], "1 of 4 are negative"),
        ([0.0, 1.0, 2.0, 3.0, 4.0], "they count the frames, from 0 to 4"),
        ([0.0, 5.0, 10.0, 20.0, 25.0, 30.0], "they count the frames"),
        (
            [0.0, 9.0, 22.0, 31.0, 45.0, 52.0],
            "they number the frames, from 0 to 52: in milliseconds they would be too",
        ),
        ([*CAMERA[6:], *CAMERA[:6]], "1 of 12 are smaller than the one before"),
        ([0.05, 0.21, 0.12, 0.30, 0.08, 0.17], "2 of 6 are smaller than the one before"),
    ],
)
def test_numbers_that_are_no_times(numbers, why):
    found = judge_stamps(numbers)
    assert found.times_s is None
    assert why in found.why_not


def test_leading_zeros_number_frames():
    clock_or_chosen_frames = [0.0, 28.0, 61.0, 95.0, 130.0]
    found = judge_stamps(clock_or_chosen_frames)
    assert found.is_guess
    assert found.unit == "ms"
    assert not judge_stamps([1000 * t for t in CAMERA]).is_guess
    padded = judge_stamps(clock_or_chosen_frames, padded=True)
    assert padded.times_s is None
    assert padded.why_not == "they number the frames, with leading zeros, from 0 to 130"
    assert judge_stamps(clock_or_chosen_frames, unit="none").times_s is None
    assert judge_stamps(clock_or_chosen_frames, unit="ms", padded=True).times_s == pytest.approx(
        [0, 0.028, 0.061, 0.095, 0.13]
    )


def test_ticks_of_windows_and_dotnet_are_known_by_their_dates():
    """24 September 2021 in ticks of 100 ns after the year 1601, and after the year 1."""
    for ticks in (132769152000000000.0, 637680384000000000.0):
        found = judge_stamps([ticks + round(i / 30 * 1e7) for i in range(6)])
        assert found.unit == "100ns"
        assert found.times_s is not None
        assert [t - found.times_s[0] for t in found.times_s] == pytest.approx(
            [i / 30 for i in range(6)], abs=1e-5
        )


def test_lists_of_one_recording_have_one_unit():
    every_6th = [1000 * i / 5 for i in range(4)]
    colour_us = [1e6 * i / 30 for i in range(19)]
    depth_us = colour_us[::6]
    assert time_unit(every_6th) == "ms"
    assert common_unit([colour_us, depth_us]) == "us"
    slow_us = [6e5 * i for i in range(4)]  # at 1.7 Hz, alone, as if in nanoseconds
    assert time_unit(slow_us) == "ns"
    assert common_unit([colour_us, slow_us]) == "us"
    assert common_unit([[1.7e18 + 1e9 * i for i in range(4)], [5.0]]) == "ns"


@pytest.mark.parametrize(
    ("unit", "per_s"),
    [("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("100ns", 1e7)],
)
def test_times_of_the_plain_layout_are_seconds(tmp_path, unit, per_s):
    images = [tmp_path / f"{i:06d}.png" for i in range(4)]
    start = 13276915200 if unit == "100ns" else 1700000000
    lines = [f"{image.stem} {int((start + i / 15) * per_s)}" for i, image in enumerate(images)]
    (tmp_path / "times.txt").write_text("\n".join(lines))
    with pytest.raises(
        SequenceError, match=rf"must hold seconds, .* as {unit} it is one in 0\.06\d* s"
    ):
        times_of_images(tmp_path / "times.txt", images)


def test_a_slow_recording_has_its_times(tmp_path):
    images = [tmp_path / f"{i}.png" for i in range(4)]
    (tmp_path / "times.txt").write_text(
        "".join(f"{image.stem} {1700000000 + 8 * i}\n" for i, image in enumerate(images))
    )
    times, why_not = times_of_images(tmp_path / "times.txt", images)
    assert why_not == ""
    assert times == [(1700000000.0 + 8 * i,) * 2 for i in range(4)]


@pytest.mark.parametrize(
    ("times", "sentence", "remedy"),
    [
        (range(40), "one frame in 1 s, but they are whole numbers.*from 0 to 39", "times=false"),
        (range(100, 140, 2), "one frame in 2 s, but they are whole", "times=false"),
        ([0, 3, 4, 9, 12, 13], "they are whole numbers", "times=false"),
        (
            [i / 900 for i in range(40)],
            "one frame in 0.00111 s, .* 1 to 120 frames a second; in minutes .* 0.0667 s",
            "holds minutes: multiply them by 60",
        ),
        (
            [i / 15 / 3600 for i in range(40)],
            "in hours it would be one in 0.0667 s",
            "multiply them by 3600",
        ),
        (
            [33.3 * i for i in range(40)],
            "one frame in 33.3 s, .* in ms .* 0.0333 s",
            "divide them by 1000",
        ),
        ([2.5 * i for i in range(40)], "one frame in 2.5 s, .* 120 frames a second$", "seconds"),
    ],
)
def test_times_that_may_not_be_seconds_are_doubted(times, sentence, remedy):
    doubt = doubt_on_times(
        [*map(float, times)], if_counted="--reader times=false", name="times.txt"
    )
    assert doubt is not None
    assert re.search(sentence, doubt.sentence)
    assert remedy in doubt.remedy


@pytest.mark.parametrize("step", [1 / 125, 1 / 90, 1 / 30, 0.5, 1.0])
def test_times_of_films_are_not_doubted(step):
    """Also a recording of which every 30th frame was kept."""
    from_start = [0.123 + step * i for i in range(40)]
    dated = [1700000000.0 + 8 * i for i in range(40)]
    for times in (from_start, dated, CAMERA, [], [0.0], [0.0, 0.0], [0.0, 0.1, 0.4]):
        assert doubt_on_times(times, if_counted="", name="times.txt") is None


def test_decimal_names_are_in_the_order_of_their_numbers():
    names = ["1700000000.03.png", "1700000000.1.png", "1700000001.png", "rgb2.png", "rgb10.png"]
    shuffled = [Path(names[i]) for i in (1, 3, 0, 4, 2)]
    assert [path.name for path in sorted(shuffled, key=natural_order)] == names


@pytest.mark.parametrize(
    "line", ["rgb\\a b.png", "rgb/a b.png", '"rgb/a b.png"', "'rgb\\a b.png'", "rgb/a b.png  "]
)
def test_listed_names_with_spaces_backslashes_and_quotes(tmp_path, line):
    image = tmp_path / "rgb/a b.png"
    image.parent.mkdir()
    image.touch()
    (tmp_path / "list.txt").write_text(f"# comment\n1.5 {line}\n")
    assert read_image_list(tmp_path / "list.txt") == [[(1.5, image)]]
    (tmp_path / "pairs.txt").write_text(f"1.5 {line} 1.6 {line}\n")
    assert read_image_list(tmp_path / "pairs.txt", per_line=2) == [[(1.5, image), (1.6, image)]]


@pytest.mark.parametrize("line", ["1.5", "x rgb/a.png", "nan rgb/a.png", "1.2.3 rgb/a.png"])
def test_bad_lines_of_lists(tmp_path, line):
    (tmp_path / "list.txt").write_text(line)
    with pytest.raises(SequenceError, match=r"list\.txt line 1 must be 'timestamp filename', got"):
        read_image_list(tmp_path / "list.txt")


@pytest.mark.parametrize(
    ("unit", "per_s"),
    [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)],
)
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
    assert associate(
        [0.0, 1.0, 2.0],
        [0.01, 1.03, 1.99],
        max_difference_s=0.05,
    ) == [
        (0, 0),
        (1, 1),
        (2, 2),
    ]


def test_each_entry_is_used_once_and_the_best_pair_wins():
    # both want entry 0; the second is nearer, so the first takes what is left
    assert associate([0.000, 0.012], [0.010, 0.019], max_difference_s=0.02) == [(0, 1), (1, 0)]
    assert associate([0.000, 0.012], [0.010], max_difference_s=0.02) == [(1, 0)]


def test_against_exhaustive_search():
    first = [0.033 * i + 0.004 * ((7 * i) % 5) for i in range(60)]
    second = [0.0335 * i + 0.003 * ((11 * i) % 7) for i in range(60)]
    pairs = associate(first, second)
    left = {
        (i, j): abs(a - b)
        for i, a in enumerate(first)
        for j, b in enumerate(second)
        if abs(a - b) <= 0.02
    }
    expected = []
    while left:
        i, j = min(left, key=lambda pair: (left[pair], pair))
        expected.append((i, j))
        left = {p: d for p, d in left.items() if p[0] != i and p[1] != j}
    assert pairs == sorted(expected)
    assert len(pairs) > 40


def test_a_file_of_seconds_may_hold_whole_seconds():
    assert judge_stamps([0.0, 1.0, 2.0, 3.0], unit="s").times_s == [0, 1, 2, 3]


def test_any_order_and_empty():
    assert associate([2.0, 0.0, 1.0], [1.0, 2.0, 0.0]) == [(1, 2), (2, 0), (0, 1)]
    assert associate([], [1.0]) == []
    assert associate([1.0], []) == []
