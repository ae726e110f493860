"""Every breakage is named, and nothing else is; the repair it prints repairs it."""

import pytest

from gsfusion_nb.recordings.checkup import check_recording

# names are spelled out here because conftest cannot be imported; a test below compares
FAST = ("clean", "depth 5000 as 1000", "opengl")
IN_CI = ("focal", "colour ahead", "inverted", "wxyz", "pose jump", "65535", "colour moved")
SLOW = (
    "depth 4 % off",
    "mm poses",
    "ros",
    "unity",
    "opengl view matrices",
    "path is interrupted",
    "poses early",
    "poses late",
    "cx cy",
    "half intrinsics",
    "half a pixel",
    "other size",
    "ray depth",
    "other camera",
    "mirrored",
    "mixed up",
    "exposure",
    "blur",
    "frozen",
)
REAL = ("redkitchen250", "livingroom1_clean211", "redkitchen_mini48")
TOO_NOISY = ("half a pixel",)
"""Not to be seen through a Kinect's noise."""


def test_all_breakages_are_listed(breakages):
    assert {*FAST, *IN_CI, *SLOW} == set(breakages)


def expected_value(value, intrinsics):
    """Number and tolerance of an expected repair; a name stands for the clean recording's
    intrinsics."""
    number, tolerance = value
    if number == "code":
        return 65535 / intrinsics["depth_scale"], tolerance
    if isinstance(number, str):
        number = intrinsics[number] + (0.5 if number in ("cx", "cy") else 0.0)
        return number, tolerance * intrinsics["width"]
    return number, tolerance


def examine(broken, breakages, source, name):
    """The check-up's report of a broken recording, compared with what it must say."""
    breakage = breakages[name]
    recording, intrinsics = broken(source, name)
    report = check_recording(recording.root, pictures=False)
    assert {f.name for f in report.trouble} == breakage.named, str(report)
    for field, value in breakage.repair.items():
        found = getattr(report.data, field, None)
        found = getattr(report.data.repair, field) if found is None else found
        if isinstance(value, tuple) and field != "skip":
            if field.startswith("rgb_shift"):
                value = (value[0] * intrinsics["width"] / 640, value[1])
            number, tolerance = expected_value(value, intrinsics)
            assert found == pytest.approx(
                number, abs=tolerance if field != "depth_max_m" else 0.02 * number
            )
        else:
            assert found == value
    return recording, report


@pytest.mark.parametrize("name", FAST)
def test_the_room(broken, breakages, name):
    examine(broken, breakages, "small room", name)


@pytest.mark.ci
@pytest.mark.parametrize("name", IN_CI)
def test_the_room_in_more_ways(broken, breakages, name):
    examine(broken, breakages, "room", name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FAST, *SLOW])
def test_the_room_in_every_way(broken, breakages, name):
    examine(broken, breakages, "room", name)


@pytest.mark.slow
@pytest.mark.parametrize("source", REAL)
@pytest.mark.parametrize(
    "name",
    [n for n in (*FAST, *IN_CI, *SLOW) if n != "clean"],
)
def test_real_sequences(broken, breakages, source, name):
    if name in TOO_NOISY and source.startswith("redkitchen"):
        recording, _ = broken(source, name)
        report = check_recording(recording.root, pictures=False)
        assert report.ok
        return
    examine(broken, breakages, source, name)


@pytest.mark.ci
@pytest.mark.parametrize("source", REAL)
def test_clean_sequences_get_a_clean_bill(shared_sequence, source):
    report = check_recording(shared_sequence(source), frames=31, pictures=False)
    assert report.ok, str(report)
    assert report.flags == ""


@pytest.mark.slow
@pytest.mark.parametrize("source", REAL)
def test_whole_clean_sequences(shared_sequence, source):
    report = check_recording(shared_sequence(source))
    assert report.ok, str(report)
    assert report.frames_read == report.length


@pytest.mark.slow
@pytest.mark.parametrize("source", ["room", *REAL])
@pytest.mark.parametrize("name", [*FAST[1:], *IN_CI, *SLOW])
def test_every_repair_repairs(broken, breakages, source, name):
    if not breakages[name].mends or (name in TOO_NOISY and source.startswith("redkitchen")):
        pytest.skip("there is no repair for this")
    recording, report = examine(broken, breakages, source, name)
    again = check_recording(recording.root, data=report.data, pictures=False)
    assert again.ok, str(again)
    assert again.data == report.data  # nothing on top


@pytest.mark.slow
def test_two_breakages_at_once(broken, breakages):
    recording, _ = broken("room", "opengl view matrices")
    breakages["depth 5000 as 1000"].break_it(recording)
    report = check_recording(recording.root, pictures=False)
    assert {f.name for f in report.trouble} == {"pose direction", "pose axes", "depth scale"}
    assert report.data.repair.depth_factor == 0.2
