"""Folders in the manner of the TUM benchmark."""

import pytest

from gsfusion_nb.data import SequenceError
from gsfusion_nb.data.convert import ConvertOptions, convert, detect_format


def write_tum(root, takes, *, lists=True, truth=True):
    c = takes.camera
    for i, t in enumerate(takes.times_s):
        takes.write(root / f"rgb/{t + 0.005:.6f}.png", takes.png(i))
        takes.write(root / f"depth/{t:.6f}.png", takes.depth_png(i, 5000))
    if lists:
        for name, shift in (("rgb", 0.005), ("depth", 0.0)):
            lines = [f"{t + shift:.6f} {name}/{t + shift:.6f}.png" for t in takes.times_s]
            (root / f"{name}.txt").write_text("\n".join(["# timestamp filename", *lines, ""]))
    if truth:
        rows = [" ".join(f"{v:.9f}" for v in (t, *takes.tum_row(i))) for i, t in enumerate(takes.times_s)]
        (root / "groundtruth.txt").write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *rows, ""]))
    (root / "calibration.txt").write_text(f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}\n")
    return root


@pytest.mark.parametrize("lists", [True, False])
def test_reads_what_was_written(tmp_path, takes, lists):
    root = write_tum(tmp_path / "scan", takes, lists=lists)
    assert detect_format(root) == "tum"
    report = convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", depth_m=1.1e-4)
    assert (report.frames, report.depth_scale, report.dropped) == (4, 5000, {})
    assert str(report).splitlines()[-1] == f"Next: gsfusion-nb check {tmp_path / 'out'}"
    assert (tmp_path / "out/rgb/000000.png").read_bytes() == takes.png(0)


def test_associations(tmp_path, takes):
    root = write_tum(tmp_path / "scan", takes, lists=False)
    lines = [f"{t:.6f} depth/{t:.6f}.png {t + 0.005:.6f} rgb/{t + 0.005:.6f}.png" for t in takes.times_s]
    (root / "associations.txt").write_text("\n".join(lines))
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", depth_m=1.1e-4)


def test_without_poses_or_intrinsics_says_what_to_give(tmp_path, takes):
    root = write_tum(tmp_path / "scan", takes, truth=False)
    with pytest.raises(SequenceError, match=r"scan holds no poses; give a trajectory with --poses FILE"):
        convert(root, tmp_path / "out")
    (root / "calibration.txt").unlink()
    with pytest.raises(SequenceError, match=r"does not contain the camera's intrinsics; give --intrinsics"):
        convert(root, tmp_path / "out", options=ConvertOptions(poses="none"))
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.partial").exists()


def test_calibration_is_not_named_where_the_user_gave_another(tmp_path, takes):
    root = write_tum(tmp_path / "scan", takes)
    c = takes.camera
    own = convert(root, tmp_path / "own")
    assert any(note.startswith(f"intrinsics from {root / 'calibration.txt'}") for note in own.notes)
    given = ConvertOptions(intrinsics=f"{c.fx + 7} {c.fy} {c.cx - 0.5} {c.cy - 0.5}")
    report = convert(root, tmp_path / "given", options=given)
    assert not any("intrinsics from" in note for note in report.notes)


def test_no_poses_on_purpose(tmp_path, takes):
    from gsfusion_nb.data.readers import folder

    root = write_tum(tmp_path / "scan", takes)
    report = convert(root, tmp_path / "out", options=ConvertOptions(poses="none"))
    assert str(report).endswith(f"Next: gsfusion-nb check {tmp_path / 'out'} --reader poses=false")
    assert not folder(tmp_path / "out", poses=False).has_poses


def test_names_that_are_no_times(tmp_path, takes):
    takes.write(tmp_path / "rgb/first.png", takes.png(0))
    takes.write(tmp_path / "depth/first.png", takes.depth_png(0))
    with pytest.raises(SequenceError, match=r"first\.png is not named by its time, and there is no rgb\.txt"):
        convert(str(tmp_path), tmp_path / "out", format="tum")


@pytest.mark.parametrize("distortion", ["0 0 5 5", "1e30 0 0 0"])
def test_a_distortion_that_no_pinhole_undoes_is_a_sentence(tmp_path, takes, distortion):
    root, c = write_tum(tmp_path / "scan", takes), takes.camera
    (root / "calibration.txt").write_text(f"{c.fx} {c.fy} {c.cx} {c.cy} {distortion}")
    with pytest.raises(SequenceError, match=r"scan/rgb/.*: the distortion .* cannot be removed by a pinhole camera: "):
        convert(root, tmp_path / "out")
