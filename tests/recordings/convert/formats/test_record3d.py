"""Record3D: .r3d archives, unpacked folders, the EXR export, LZFSE."""

import json
import struct
import zipfile

import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.recordings.convert import ConvertOptions, convert, detect_format
from gsfusion_nb.recordings.convert.formats.record3d import lzfse_unpacked

GL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def stored(data: bytes) -> bytes:
    """An LZFSE stream of one block that is not packed, as Apple's encoder writes what does not
    shrink."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def members(takes, pack=stored, **changes):
    c = takes.camera
    turned = type(takes)(
        c,
        takes.rgb,
        takes.depth_m,
        takes.T_WC @ GL,
        takes.times_s,
    )
    rows = [turned.tum_row(i) for i in range(4)]
    metadata = {
        "w": c.width,
        "h": c.height,
        "dw": c.width,
        "dh": c.height,
        "fps": 10,
        "K": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1],
        "poses": [[*row[3:], *row[:3]] for row in rows],
        "frameTimestamps": [5.0 + 0.1 * i for i in range(4)],
    }
    metadata = {k: v for k, v in (metadata | changes).items() if v is not None}
    files = {"metadata": json.dumps(metadata).encode()}
    for i in range(4):
        depth = takes.depth_m[i].astype("<f4").copy()
        depth[0, 0] = np.nan
        confidence = np.full(depth.shape, 2, np.uint8)
        confidence[1, 1] = 0
        confidence[1, 2] = 1
        files[f"rgbd/{i}.jpg"] = takes.jpeg(i)
        files[f"rgbd/{i}.depth"] = pack(depth.tobytes())
        files[f"rgbd/{i}.conf"] = pack(confidence.tobytes())
    return files


def write_r3d(path, files):
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def check(out, takes, holes):
    wanted = []
    for depth in takes.depth_m:
        wanted.append(depth.copy())
        for hole in holes:
            wanted[-1][hole] = 0
    type(takes)(takes.camera, takes.rgb, wanted, takes.T_WC, takes.times_s).check(out, rgb=3)


def test_poses_of_zeros_are_no_poses(tmp_path, takes):
    """Some captures hold zeros where ARKit did not know: no rotation, and not the identity."""
    poses = json.loads(members(takes)["metadata"])["poses"]
    some = write_r3d(
        tmp_path / "some.r3d",
        members(takes, poses=[poses[0], [0] * 7, *poses[2:]]),
    )
    assert convert(some, tmp_path / "out").dropped == {
        "tracking was lost (pose is NaN or infinite)": 1
    }
    none = write_r3d(tmp_path / "none.r3d", members(takes, poses=[[0] * 7] * 4))
    with pytest.raises(SequenceError, match=r"holds no poses.*--poses none"):
        convert(none, tmp_path / "again")


def test_equal_poses_prove_nothing(tmp_path, takes):
    poses = json.loads(members(takes)["metadata"])["poses"]
    report = convert(
        write_r3d(tmp_path / "scan.r3d", members(takes, poses=poses[:1] * 4)),
        tmp_path / "out",
    )
    assert any("all 4 poses are equal" in note and "--poses none" in note for note in report.notes)


@pytest.mark.parametrize("packed", ["r3d", "folder"])
def test_reads_what_was_written(tmp_path, takes, packed):
    source = tmp_path / "scan.r3d"
    if packed == "r3d":
        write_r3d(source, members(takes))
    else:
        for name, data in members(takes).items():
            takes.write(source / name, data)
    assert detect_format(source) == "record3d"
    convert(source, tmp_path / "out")
    check(tmp_path / "out", takes, [(0, 0), (1, 1)])
    assert json.loads((tmp_path / "out/intrinsics.json").read_text())["fps"] == pytest.approx(10)


def test_a_missing_image_does_not_shift_poses_and_times(tmp_path, takes):
    files = members(takes)
    whole = write_r3d(tmp_path / "whole.r3d", files)
    rest = write_r3d(
        tmp_path / "rest.r3d", {name: data for name, data in files.items() if "/1." not in name}
    )
    convert(whole, tmp_path / "a")
    convert(rest, tmp_path / "b")
    a = folder(tmp_path / "a")
    b = folder(tmp_path / "b")
    assert torch.equal(b.poses, a.poses[[0, 2, 3]])
    assert b.timestamps_s == pytest.approx([5.0, 5.2, 5.3])


def test_lists_that_end_before_the_last_frame_are_told(tmp_path, takes):
    """Times since the start are not put behind times of a clock."""
    c = takes.camera
    files = members(
        takes,
        frameTimestamps=[5.0, 5.1, 5.2],
        perFrameIntrinsicCoeffs=[[c.fx, c.fy, c.cx, c.cy]] * 2,
    )
    notes = convert(write_r3d(tmp_path / "short.r3d", files), tmp_path / "out").notes
    assert "frameTimestamps is of the first 3 of 4 frames: the others have no time" in notes
    assert any(note.startswith("perFrameIntrinsicCoeffs is of the first 2 of 4") for note in notes)
    times = (tmp_path / "out/times.txt").read_text().split()
    assert times[3::2] == ["5.0", "5.1", "5.2", "nan"]


@pytest.mark.parametrize(
    ("least", "holes"),
    [(0, []), (2, [(1, 1), (1, 2)])],
)
def test_confidence(tmp_path, takes, least, holes):
    convert(
        write_r3d(tmp_path / "a.r3d", members(takes)),
        tmp_path / "out",
        options=ConvertOptions(confidence=least),
    )
    check(tmp_path / "out", takes, [(0, 0), *holes])


def test_focal_length_of_every_frame(tmp_path, takes):
    """Frames with a longer focal length are brought to the camera of the first."""
    c = takes.camera
    coefficients = [[c.fx * f, c.fy * f, c.cx, c.cy] for f in (1.0, 1.0, 1.5, 1.0)]
    files = members(takes, K=None, perFrameIntrinsicCoeffs=coefficients)
    convert(write_r3d(tmp_path / "a.r3d", files), tmp_path / "out")
    sequence = folder(tmp_path / "out")
    assert vars(sequence.camera) == pytest.approx(vars(c))
    shrunk = sequence[2].depth_m.numpy()
    same = takes.depth_m[2]
    for v, u in (
        (10, 20),
        (24, 32),
        (30, 45),
    ):  # pixel centres move towards the principal point by 1.5
        at = [round((x + 0.5 - p) * 1.5 + p - 0.5 - 1e-3) for x, p in ((v, c.cy), (u, c.cx))]
        assert shrunk[v, u] == pytest.approx(same[at[0], at[1]], abs=6e-4)
    assert np.abs(sequence[3].depth_m.numpy() - takes.depth_m[3])[2:].max() < 6e-4


def test_lzfse_with_the_library(tmp_path, takes):
    liblzfse = pytest.importorskip("liblzfse")
    data = takes.depth_m[0].astype("<f4").tobytes()
    assert lzfse_unpacked(liblzfse.compress(data), "x") == data
    convert(write_r3d(tmp_path / "a.r3d", members(takes, liblzfse.compress)), tmp_path / "out")
    check(tmp_path / "out", takes, [(0, 0), (1, 1)])


def test_mistakes_are_answered_with_a_sentence(tmp_path, takes):
    path = write_r3d(tmp_path / "a.r3d", members(takes))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    for source in (
        path,
        write_r3d(tmp_path / "c.r3d", members(takes, w=None)),
        write_r3d(
            tmp_path / "d.r3d",
            members(takes, poses=[[0, 0, 0, 1, 0, 0, 0]]),
        ),
    ):
        with pytest.raises(SequenceError, match=source.name):
            convert(source, tmp_path / "out")
    empty = write_r3d(tmp_path / "f.r3d", {"metadata": members(takes)["metadata"]})
    with pytest.raises(
        SequenceError, match=r"f\.r3d holds no frames; expected rgbd/0\.jpg and so on"
    ):
        convert(empty, tmp_path / "out")
    files = members(takes) | {"rgbd/2.depth": b"garbage"}
    report = convert(write_r3d(tmp_path / "e.r3d", files), tmp_path / "out")
    assert report.dropped == {"image missing or damaged": 1}
