"""Folders in the manner of the TUM benchmark."""

import json

import pytest

from gsfusion_nb.data import SequenceError, open_sequence
from gsfusion_nb.recordings.convert import ConvertOptions, convert, detect_format


def write_tum(root, takes, *, lists=True, truth=True):
    c = takes.camera
    for i, t in enumerate(takes.times_s):
        takes.write(root / f"rgb/{t:.6f}.png", takes.png(i))
        takes.write(root / f"depth/{t + 0.005:.6f}.png", takes.depth_png(i, 5000))
    if lists:
        for name, shift in (("rgb", 0.0), ("depth", 0.005)):
            lines = [f"{t + shift:.6f} {name}/{t + shift:.6f}.png" for t in takes.times_s]
            (root / f"{name}.txt").write_text("\n".join(["# timestamp filename", *lines, ""]))
    if truth:
        rows = [
            " ".join(f"{v:.9f}" for v in (t, *takes.tum_row(i)))
            for i, t in enumerate(takes.times_s)
        ]
        (root / "groundtruth.txt").write_text(
            "\n".join(["# timestamp tx ty tz qx qy qz qw", *rows, ""])
        )
    (root / "calibration.txt").write_text(f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}\n")
    return root


@pytest.mark.parametrize("lists", [True, False])
def test_reads_what_was_written(tmp_path, takes, lists):
    root = write_tum(tmp_path / "scan", takes, lists=lists)
    assert detect_format(root) == ("tum" if lists else "images")
    report = convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", depth_m=1.1e-4)
    assert (report.frames, report.depth_scale, report.dropped) == (4, 5000, {})
    assert str(report).splitlines()[-1] == f"Next: gsfusion-nb check {tmp_path / 'out'}"
    assert (tmp_path / "out/rgb/000000.png").read_bytes() == takes.png(0)


def test_associations(tmp_path, takes):
    root = write_tum(tmp_path / "scan", takes, lists=False)
    lines = [
        f"{t + 0.005:.6f} depth/{t + 0.005:.6f}.png {t:.6f} rgb/{t:.6f}.png" for t in takes.times_s
    ]
    (root / "associations.txt").write_text("\n".join(lines))
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", depth_m=1.1e-4)


def test_lists_and_trajectory_that_count_the_frames(tmp_path, takes):
    """As ElasticFusion reads them: "1 depth/1.png 1 rgb/1.png", and poses "1 tx ty tz qx qy qz
    qw"."""
    root = tmp_path / "scan"
    for i in range(len(takes)):
        takes.write(root / f"rgb/{i + 1}.png", takes.png(i))
        takes.write(root / f"depth/{i + 1}.png", takes.depth_png(i, 5000))
    numbers = range(1, len(takes) + 1)
    (root / "associations.txt").write_text(
        "".join(f"{n} depth/{n}.png {n} rgb/{n}.png\n" for n in numbers)
    )
    rows = [" ".join([str(n), *(f"{v:.9f}" for v in takes.tum_row(n - 1))]) for n in numbers]
    (root / "groundtruth.txt").write_text("\n".join(rows[1:]))
    c = takes.camera
    (root / "calibration.txt").write_text(f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}\n")
    report = convert(root, tmp_path / "out", options=ConvertOptions(depth_scale=5000.0))
    takes.check(
        tmp_path / "out",
        frames=[1, 2, 3],
        depth_m=1.1e-4,
        pose=1e-5,
    )
    assert report.dropped == {"the trajectory has no pose of its number": 1}


def test_ticks_of_a_hololens(tmp_path, takes):
    """Colour, slower depth and poses in ticks of 100 ns: one unit for the three lists."""
    root = tmp_path / "scan"
    ticks = [132770000000000000 + round(t * 1e7) for t in (0.0, 0.2, 0.4, 0.6)]
    for i, tick in enumerate(ticks):
        takes.write(root / f"rgb/{tick}.png", takes.png(i))
        takes.write(root / f"depth/{tick}.png", takes.depth_png(i))
    for name, listed in (("rgb", ticks), ("depth", ticks[::3])):
        (root / f"{name}.txt").write_text("".join(f"{tick} {name}/{tick}.png\n" for tick in listed))
    rows = [
        " ".join([str(tick), *(f"{v:.9f}" for v in takes.tum_row(i))])
        for i, tick in enumerate(ticks)
    ]
    (root / "groundtruth.txt").write_text("\n".join(rows))
    c = takes.camera
    (root / "calibration.txt").write_text(f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}\n")
    convert(root, tmp_path / "out", options=ConvertOptions(depth_scale=1000.0))
    takes.check(tmp_path / "out", frames=[0, 3], pose=1e-5)


def test_images_outside_of_the_folder_are_told(tmp_path, takes, caplog):
    """A list of somebody else's may name any file of this machine."""
    root = write_tum(tmp_path / "freiburg1", takes)
    (root / "calibration.txt").unlink()
    (root / "rgb").rename(tmp_path / "elsewhere")
    lists = (root / "rgb.txt").read_text()
    (root / "rgb.txt").write_text(lists.replace(" rgb/", " ../elsewhere/"))
    c = takes.camera
    options = ConvertOptions(intrinsics=f"{c.fx} {c.fy} {c.cx} {c.cy}", depth_scale=5000.0)
    report = convert(root, tmp_path / "out", options=options)
    told = f"4 of the listed images lie outside of {root}, the first is {tmp_path / 'elsewhere'}"
    assert any(note.startswith(told) for note in report.notes)
    open_sequence(root, camera=takes.camera)
    assert told in caplog.text


def test_without_poses_or_intrinsics_says_what_to_give(tmp_path, takes):
    root = write_tum(tmp_path / "scan", takes, truth=False)
    with pytest.raises(
        SequenceError, match=r"scan holds no poses; give a trajectory with --poses FILE"
    ):
        convert(root, tmp_path / "out")
    (root / "calibration.txt").unlink()
    with pytest.raises(
        SequenceError, match=r"does not contain the camera's intrinsics; give --intrinsics"
    ):
        convert(root, tmp_path / "out", options=ConvertOptions(poses="none"))
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / ".out.partial").exists()
    named = root.rename(tmp_path / "freiburg1_small")  # another camera's images, by their size
    with pytest.raises(
        SequenceError, match=r"does not contain the camera's intrinsics; give --intrinsics"
    ):
        convert(named, tmp_path / "out", options=ConvertOptions(poses="none"))


def untimed(root, takes, line, *, names=("rgb{}", "depth{}")):
    """Images named ``names``, and an association file of ``line(i, colour, depth)`` if there is
    one."""
    lines = []
    for i in range(len(takes)):
        colour, depth = (
            f"{kind}/{name.format(f'{i:02d}')}.png"
            for kind, name in zip(("rgb", "depth"), names, strict=True)
        )
        takes.write(root / colour, takes.png(i))
        takes.write(root / depth, takes.depth_png(i, 5000))
        lines.append(line(i, colour, depth) if line else "")
    if line:
        (root / "associations.txt").write_text("\n".join(lines))
    c = takes.camera
    (root / "calibration.txt").write_text(f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}\n")
    return root


def test_durations_neither_sort_the_frames_nor_make_a_frame_rate(tmp_path, takes):
    seconds = (0.0166, 0.0058, 0.0331, 0.0071)
    root = untimed(tmp_path / "scan", takes, lambda i, c, d: f"{seconds[i]} {c} {seconds[i]} {d}")
    convert(root, tmp_path / "out", options=ConvertOptions(poses="none"))
    assert [f.read_bytes() for f in sorted((tmp_path / "out/rgb").iterdir())] == [
        takes.png(i) for i in range(4)
    ]
    assert "fps" not in json.loads((tmp_path / "out/intrinsics.json").read_text())
    assert "are not times" in (tmp_path / "out/conversion.json").read_text()
    (root / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    with pytest.raises(SequenceError, match=r"groundtruth\.txt.*--poses none"):
        convert(root, tmp_path / "again")


def test_names_that_are_no_times_pair_the_images(tmp_path, takes):
    none = ConvertOptions(poses="none")
    for folder, names in (
        ("a", ("{}", "{}")),
        ("b", ("rgb{}", "depth{}")),
        ("c", ("{}-left", "{}-d")),
    ):
        report = convert(
            untimed(tmp_path / folder, takes, None, names=names),
            tmp_path / f"out {folder}",
            options=none,
        )
        assert report.frames == 4
        assert any("no times or frame rate are written" in note for note in report.notes)
    (tmp_path / "c/rgb/01-left.png").unlink()
    report = convert(tmp_path / "c", tmp_path / "three", options=none)
    assert (report.frames, report.dropped) == (3, {"no colour image of its number": 1})
    for name in ("00", "02", "03"):
        (tmp_path / f"c/rgb/{name}-left.png").rename(tmp_path / f"c/rgb/9{name}-left.png")
    with pytest.raises(SequenceError, match=r"3 colour and 4 depth images without times"):
        convert(tmp_path / "c", tmp_path / "again", options=none)


def test_the_unit_of_depth_is_inferred_or_asked_for(tmp_path, takes):
    report = convert(write_tum(tmp_path / "scan", takes), tmp_path / "out")
    assert any(
        n.startswith("depth was taken as 5000 units a metre, measured by the camera's")
        for n in report.notes
    )
    guessed = convert(tmp_path / "scan", tmp_path / "guessed", options=ConvertOptions(poses="none"))
    assert any(
        "because that gives depths of a hand-held camera" in n and "--depth-scale" in n
        for n in guessed.notes
    )
    root = write_tum(tmp_path / "millimetres", takes)
    for i, t in enumerate(takes.times_s):
        takes.write(root / f"depth/{t + 0.005:.6f}.png", takes.depth_png(i, 1000))
    assert convert(root, tmp_path / "mm").depth_scale == 1000
    takes.check(tmp_path / "mm")
    for i, t in enumerate(takes.times_s):
        takes.write(root / f"depth/{t + 0.005:.6f}.png", takes.depth_png(i, 20))
    with pytest.raises(
        SequenceError, match=r"unit of depth cannot be known from the files.*give --depth-scale"
    ):
        convert(root, tmp_path / "unknown")
