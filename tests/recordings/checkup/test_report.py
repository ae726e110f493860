"""What a check-up gives: findings by name, text, a page, a notebook's view; the command."""

import json
import re
from typing import Any

import pytest
import torch

from gsfusion_nb.cli import main
from gsfusion_nb.config import DataConfig, RepairConfig
from gsfusion_nb.data import SequenceError, open_sequence
from gsfusion_nb.data.room import room
from gsfusion_nb.recordings.checkup import CheckupReport, Finding, check_recording


def small_report() -> CheckupReport:
    findings = [
        Finding(
            name="depth scale",
            verdict="wrong",
            sentence="Depth <b> must.",
            repair="--data.repair.depth-factor 0.2",
        ),
        Finding(name="sharpness", verdict="doubtful", sentence="Blurred."),
        Finding(name="frames", verdict="ok", sentence="All."),
    ]
    data = DataConfig(depth_max_m=9.5, repair=RepairConfig(depth_factor=0.2, skip=(3, 4)))
    return CheckupReport(
        name="scan",
        findings=findings,
        data=data,
        length=9,
        frames_read=9,
        reader={"register": True},
    )


def test_a_report_as_text_and_html():
    report = small_report()
    assert report.verdict == "wrong"
    assert [f.name for f in report.trouble] == ["depth scale", "sharpness"]
    with pytest.raises(KeyError, match="depth scale, sharpness"):
        report["depth"]
    text = str(report)
    assert "1 wrong, 1 doubtful of 3 properties checked" in text
    assert "-> --data.repair.depth-factor 0.2" in text
    html = report._repr_html_()
    assert "Depth &lt;b&gt; must." in html
    assert "Findings that are ok: 1." in html


@pytest.mark.ci
def test_the_command_writes_a_page_and_its_flags_are_accepted(broken, tmp_path, capsys):
    recording, _ = broken("room", "inverted")
    page = tmp_path / "page.html"
    assert main(["check", str(recording.root), "--out", str(page)]) == 1
    text = capsys.readouterr().out
    assert "-> --data.repair.poses world_to_camera" in text
    html = page.read_text(encoding="utf-8")
    assert html.count("data:image/jpeg") >= 4
    assert "Path from above" in html
    assert "http" not in html.replace("http://www.w3.org", "")
    flags = text.split("All repairs together: ")[1].splitlines()[0].split()
    assert main(["check", str(recording.root), "--out", str(page), *flags]) == 0
    assert "is in order" in capsys.readouterr().out
    small = (
        "--data.width 80 --data.height 60 --data.stop 4 --tsdf.voxel-size-m 0.05 --sh-degree 0 "
        "--no-evaluate"
    )
    out = tmp_path / "run"
    assert main(["map", str(recording.root), *small.split(), *flags, "--out", str(out)]) == 0
    saved = json.loads((out / "config.json").read_text())["config"]
    assert saved["data"]["repair"]["poses"] == "world_to_camera"
    assert "inconsistent" not in capsys.readouterr().out


def test_pictures_of_a_repair_that_leaves_frames_out(broken):
    """Positions in the repaired recording are not those in the recording as read."""
    recording, _ = broken("small room", "path is interrupted")
    report = check_recording(recording.root)
    assert report.data.stop == 20
    repaired = [title for title in report.pictures if "repaired" in title]
    assert len(repaired) == 2
    assert all(
        int(number) < 20 for title in repaired for number in re.findall(r"rame (\d+)", title)
    )


def test_without_poses_no_poses_are_judged(broken):
    recording, _ = broken("small room", "clean")
    (recording.root / "poses.txt").unlink()
    report = check_recording(recording.root, poses=False)
    assert report.ok
    assert (
        report["poses"].verdict
        == report["depth scale"].verdict
        == report["time stamps"].verdict
        == "unknown"
    )
    posed = {
        "pose time",
        "pose direction",
        "pose matrices",
        "focal length",
        "agreement",
        "pose jumps",
        "exposure",
    }
    assert not posed & {f.name for f in report.findings}
    assert "cannot be known from it" in report.summary
    assert report._repr_html_().count('<td class="v unknown">') == 3
    assert all("depth edges" in title for title in report.pictures)
    recording.write(depth_scale=recording.intrinsics["depth_scale"] * 10)
    found = check_recording(recording.root, poses=False, pictures=False)["depth scale"]
    assert found.verdict == "doubtful"
    assert found.repair == "--data.repair.depth-factor 10"


def test_frozen_frames_are_found_pixel_by_pixel(broken):
    recording, _ = broken("small room", "frozen")
    poses = recording.root / "poses.txt"
    kept = poses.read_text()
    poses.unlink()
    found = check_recording(recording.root, pictures=False, poses=False)["frozen frames"]
    assert (found.verdict, found.repair) == ("doubtful", "--data.repair.skip 10 11")
    poses.write_text(kept)
    recording.change_images(
        "depth",
        lambda i, d: d[i] + (d[i] > 0).astype(d[i].dtype) * i,
    )  # noise of a live sensor
    report = check_recording(recording.root, pictures=False)
    assert report["frozen frames"].verdict == "wrong"
    assert set(report.data.repair.skip) == {10, 11}


@pytest.mark.ci
def test_a_sequence_in_memory_is_left_alone():
    sequence: Any = room(n_frames=400, width=80, height=60)
    report = check_recording(sequence, frames=31, pictures=False)
    assert report.frames_read == 31
    assert report.length == 400
    assert report.ok


def test_few_or_damaged_frames(broken):
    recording, _ = broken("small room", "clean")
    with pytest.raises(SequenceError, match="is not a folder"):
        check_recording(recording.root / "nowhere")
    (recording.root / "poses.txt").unlink()
    files = sorted((recording.root / "depth").iterdir())
    for f in files[:5]:
        f.write_bytes(b"")
    report = check_recording(recording.root, pictures=False, poses=False)
    assert report["frames"].verdict == "doubtful"
    assert "5 of 30 frames cannot be used" in report["frames"].sentence
    for f in files[:-1]:
        f.write_bytes(b"")
    report = check_recording(recording.root, poses=False)  # nothing to compare
    assert report["frames"].verdict == "wrong"
    assert report.frames_read == 1
    assert "29 of 30 frames" in str(report)
    for f in files:
        f.write_bytes(b"")
    report = check_recording(recording.root, poses=False)
    assert report.frames_read == 0
    assert report.flags == "--reader poses=false"


@pytest.mark.slow
def test_seven_scenes_is_told_to_register(shared_sequence, tmp_path):
    """Colour of a second camera, in the layout of 7-Scenes: the reader has a better repair than a
    shift."""
    import cv2

    from gsfusion_nb.data import seven_scenes
    from gsfusion_nb.data.depth_registration import warp_depth
    from gsfusion_nb.data.readers.seven_scenes import DEPTH_CAMERA, T_DEPTH_COLOUR

    view = open_sequence(
        shared_sequence("redkitchen250"), data=DataConfig(start=200, stop=230, hold_out_every=0)
    )
    for i, frame in enumerate(view):
        stem = tmp_path / f"seq-01/frame-{i:06d}"
        stem.parent.mkdir(exist_ok=True)
        depth_m = warp_depth(frame.depth_m, frame.camera, DEPTH_CAMERA, T_DEPTH_COLOUR.float())
        cv2.imwrite(f"{stem}.color.png", frame.rgb_u8.numpy()[..., ::-1])
        cv2.imwrite(f"{stem}.depth.png", (depth_m.numpy() * 1000).astype("uint16"))
        T: Any = frame.T_WC.double() @ torch.linalg.inv(T_DEPTH_COLOUR)
        (tmp_path / f"seq-01/frame-{i:06d}.pose.txt").write_text(
            "\n".join(" ".join(map(str, r)) for r in T.tolist())
        )
    assert len(seven_scenes(tmp_path)) == 30
    report = check_recording(tmp_path, pictures=False)
    assert [f.name for f in report.trouble] == ["registration"]
    assert report.flags == "--reader register=true"
    assert (
        check_recording(tmp_path, pictures=False, **report.reader)["registration"].verdict == "ok"
    )
