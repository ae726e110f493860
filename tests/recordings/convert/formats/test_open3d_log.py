"""Open3D's trajectory.log and PinholeCameraTrajectory."""

import json

import pytest

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.convert import convert, detect_format


def intrinsic(takes):
    c = takes.camera
    matrix = [c.fx, 0, 0, 0, c.fy, 0, c.cx - 0.5, c.cy - 0.5, 1]
    return {"width": c.width, "height": c.height, "intrinsic_matrix": matrix}


def write_open3d(root, takes, frames=(0, 1, 2, 3)):
    for i in range(4):
        takes.write(root / f"color/{i:05d}.png", takes.png(i))
        takes.write(root / f"depth/{i:05d}.png", takes.depth_png(i))
    text = ""
    for i in frames:
        text += (
            f"{i} {i} {i + 1}\n"
            + "\n".join(" ".join(f"{v:.9f}" for v in row) for row in takes.T_WC[i].tolist())
            + "\n"
        )
    (root / "trajectory.log").write_text(text)
    (root / "camera_intrinsic.json").write_text(json.dumps(intrinsic(takes)))
    return root


def test_reads_what_was_written(tmp_path, takes):
    root = write_open3d(tmp_path / "scan", takes)
    assert detect_format(root) == "open3d"
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")


def test_frames_without_pose_are_dropped(tmp_path, takes):
    report = convert(write_open3d(tmp_path / "scan", takes, (0, 1, 3)), tmp_path / "out")
    takes.check(tmp_path / "out", (0, 1, 3))
    assert report.dropped == {"no pose": 1}


def test_a_missing_image_does_not_shift_the_poses(tmp_path, takes):
    root = write_open3d(tmp_path / "scan", takes)
    for kind in ("color", "depth"):
        (root / kind / "00001.png").unlink()
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", (0, 2, 3))


def test_images_are_paired_by_number(tmp_path, takes):
    root = write_open3d(tmp_path / "scan", takes)
    (root / "color/00001.png").unlink()
    (root / "depth/00003.png").unlink()
    with pytest.raises(SequenceError, match=r"has a pose of frame 3, but .* holds 2 images"):
        convert(root, tmp_path / "out")


def test_json_trajectory(tmp_path, takes):
    root = write_open3d(tmp_path / "scan", takes)
    (root / "trajectory.log").unlink()
    (root / "camera_intrinsic.json").unlink()
    parameters = [
        {"extrinsic": se3.inverse(T).T.flatten().tolist(), "intrinsic": intrinsic(takes)}
        for T in takes.T_WC
    ]
    (root / "trajectory.json").write_text(
        json.dumps({"class_name": "PinholeCameraTrajectory", "parameters": parameters})
    )
    assert detect_format(root) == "open3d"
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")


def test_mistakes_are_answered_with_a_sentence(tmp_path, takes):
    root = write_open3d(tmp_path / "scan", takes)
    log = (root / "trajectory.log").read_text()
    for text in ("\n".join(log.splitlines()[:-2]), log.replace("3 3 4", "7 7 8")):
        (root / "trajectory.log").write_text(text)
        with pytest.raises(SequenceError, match=r"trajectory\.log"):
            convert(root, tmp_path / "out")
    (root / "trajectory.log").write_text(log)
    values = intrinsic(takes)
    values["intrinsic_matrix"] = [
        values["intrinsic_matrix"][i] for i in (0, 3, 6, 1, 4, 7, 2, 5, 8)
    ]  # row by row
    (root / "camera_intrinsic.json").write_text(json.dumps(values))
    with pytest.raises(SequenceError, match=r"camera_intrinsic\.json"):
        convert(root, tmp_path / "out")


@pytest.mark.parametrize("told", [True, False])
def test_the_unit_of_depth_is_not_always_millimetres(tmp_path, takes, told):
    """A calibration that says 5000 is believed; else the camera's motion tells it."""
    root = write_open3d(tmp_path / "scan", takes)
    for i in range(4):
        takes.write(root / f"depth/{i:05d}.png", takes.depth_png(i, 5000))
    if told:
        (root / "camera_intrinsic.json").write_text(
            json.dumps(intrinsic(takes) | {"depth_scale": 5000})
        )
    report = convert(root, tmp_path / "out")
    assert report.depth_scale == 5000
    assert any("5000 units a metre" in note for note in report.notes)
    takes.check(tmp_path / "out")


def test_millimetres_are_told_as_a_guess(tmp_path, takes):
    """Of one frame nothing moves, so nothing proves the unit."""
    root = write_open3d(tmp_path / "scan", takes, frames=(0,))
    for kind in ("color", "depth"):
        for i in (1, 2, 3):
            (root / f"{kind}/{i:05d}.png").unlink()
    notes = "; ".join(convert(root, tmp_path / "out").notes)
    assert "1000 units a metre, as Open3D's (--depth-scale)" in notes


def test_times_are_those_of_redwoods_names(tmp_path, takes):
    root = write_open3d(tmp_path / "scan", takes)
    report = convert(root, tmp_path / "numbers")
    assert "times are the numbers of the frames at 30 a second" in report.notes
    for kind in ("color", "depth"):
        for i in range(4):
            (root / kind / f"{i:05d}.png").rename(
                root / kind / f"{i + 1:07d}-{50_000 * i:012d}.png"
            )
    report = convert(root, tmp_path / "names")
    assert "times are the microseconds of the images' names" in report.notes
    assert folder(tmp_path / "names").timestamps_s == pytest.approx([0.0, 0.05, 0.1, 0.15])
