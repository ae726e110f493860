"""ScanNet: the .sens container byte by byte, and the exporter's folders; colour larger than
depth."""

import struct
import zlib

import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.geometry import se3
from gsfusion_nb.recordings.convert import ConvertOptions, convert, detect_format
from gsfusion_nb.types import Camera

LOST = np.full((4, 4), -np.inf)


def matrix(c):
    K = np.eye(4)
    K[0, 0] = c.fx
    K[1, 1] = c.fy
    K[0, 2] = c.cx - 0.5
    K[1, 2] = c.cy - 0.5
    return K


def write_sens(
    path,
    takes,
    *,
    lost=(),
    depth=None,
    depth_camera=None,
    extrinsic=None,
    version=4,
):
    """uint32 version ... as in sensorData.h."""
    c = takes.camera
    d = depth_camera or takes.camera
    depth = depth or takes.depth_m
    out = struct.pack("<IQ", version, 8) + b"StructIO"
    for M in (matrix(c), np.eye(4) if extrinsic is None else extrinsic, matrix(d), np.eye(4)):
        out += struct.pack("<16f", *M.flatten())
    out += struct.pack(
        "<ii4IfQ",
        2,
        1,
        c.width,
        c.height,
        d.width,
        d.height,
        1000.0,
        len(takes),
    )
    for i in range(len(takes)):
        T = LOST if i in lost else takes.T_WC[i].numpy()
        colour = takes.jpeg(i)
        packed = zlib.compress(np.rint(depth[i] * 1000).astype("<u2").tobytes())
        out += struct.pack(
            "<16f4Q",
            *T.flatten(),
            1000000 + 33333 * i,
            1000000 + 33333 * i,
            len(colour),
            len(packed),
        )
        out += colour + packed
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(out + struct.pack("<Q", 0))
    return path


def write_exported(root, takes, *, lost=()):
    for i in range(len(takes)):
        takes.write(root / f"color/{i}.jpg", takes.jpeg(i))
        takes.write(root / f"depth/{i}.png", takes.depth_png(i))
        (root / "pose").mkdir(exist_ok=True)
        np.savetxt(
            root / f"pose/{i}.txt",
            LOST if i in lost else takes.T_WC[i].numpy(),
            fmt="%f",
        )
    (root / "intrinsic").mkdir()
    for kind in ("color", "depth"):
        np.savetxt(root / f"intrinsic/intrinsic_{kind}.txt", matrix(takes.camera), fmt="%f")
        np.savetxt(root / f"intrinsic/extrinsic_{kind}.txt", np.eye(4), fmt="%f")
    return root


def test_sens(tmp_path, takes):
    path = write_sens(tmp_path / "scene0000_00/scene0000_00.sens", takes, lost=(1,))
    assert detect_format(path) == detect_format(path.parent) == "scannet"
    report = convert(path, tmp_path / "out")
    takes.check(tmp_path / "out", (0, 2, 3), rgb=3, pose=1e-5)
    assert report.dropped == {"tracking was lost (pose is NaN or infinite)": 1}
    assert (tmp_path / "out/rgb/000001.jpg").read_bytes() == takes.jpeg(2)
    times = (tmp_path / "out/times.txt").read_text().splitlines()[1:]
    assert [float(line.split()[1]) for line in times] == pytest.approx([1.0, 1.066666, 1.099999])


def test_exported_folders(tmp_path, takes):
    root = write_exported(tmp_path / "scan", takes, lost=(2,))
    assert detect_format(root) == "scannet"
    report = convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", (0, 1, 3), rgb=3, pose=2e-6)
    assert report.dropped == {"tracking was lost (pose is NaN or infinite)": 1}


def depth_views(takes, box, camera, offset=None):
    offset = torch.eye(4, dtype=torch.float64) if offset is None else offset
    poses = box.poses(4)
    rgb = [box.render(T)[0] for T in poses]
    depth = [box.render(T @ offset, camera)[1].astype(np.float32) for T in poses]
    return type(takes)(box.camera, rgb, depth, poses, takes.times_s), depth


@pytest.mark.parametrize("width", [0, 40])
def test_smaller_depth_with_intrinsics_of_its_own(tmp_path, takes, box, width):
    camera = Camera(
        width=40,
        height=30,
        fx=42.0,
        fy=43.0,
        cx=19.1,
        cy=16.2,
    )
    views, depth = depth_views(takes, box, camera)
    path = write_sens(tmp_path / "a.sens", views, depth=depth, depth_camera=camera)
    convert(path, tmp_path / "out", options=ConvertOptions(width=width))
    sequence = folder(tmp_path / "out")
    wanted = box.camera.resized(40, 30) if width else box.camera
    assert vars(sequence.camera) == pytest.approx(vars(wanted), abs=1e-4)
    for frame, T in zip(sequence, box.poses(4), strict=True):
        # the nearest depth pixel is at most half a pixel of 1.3 degrees off
        assert box.off_wall_m(frame) < 0.015
        rgb, z = box.render(T, sequence.camera)
        assert np.abs(frame.rgb_u8.numpy().astype(int) - rgb).mean() < 4
        assert np.median(np.abs(frame.depth_m.numpy() - z)[frame.depth_m.numpy() > 0]) < 0.02


def test_depth_camera_beside_the_colour_camera(tmp_path, takes, box):
    camera = Camera(
        width=128,
        height=96,
        fx=110.0,
        fy=111.0,
        cx=62.0,
        cy=47.0,
    )
    T_rig_colour = se3.exp(
        torch.tensor([0.06, 0.01, -0.02, 0.02, -0.05, 0.01], dtype=torch.float64)
    )
    views, depth = depth_views(takes, box, camera, se3.inverse(T_rig_colour))
    rig = type(takes)(
        views.camera,
        views.rgb,
        views.depth_m,
        box.poses(4) @ se3.inverse(T_rig_colour),
        takes.times_s,
    )
    path = write_sens(
        tmp_path / "a.sens", rig, depth=depth, depth_camera=camera, extrinsic=T_rig_colour.numpy()
    )
    convert(path, tmp_path / "out")
    for frame, T in zip(
        folder(tmp_path / "out"),
        box.poses(4),
        strict=True,
    ):
        assert torch.allclose(frame.T_WC.double(), T, atol=1e-5)
        assert float((frame.depth_m > 0).float().mean()) > 0.8
        assert box.off_wall_m(frame) < 0.02


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda b: b[:200], "truncated"),
        (lambda b: b[: len(b) // 2], "truncated"),
        (lambda b: b"PK\x03\x04" + b[4:], "version 67324752"),
        (lambda b: b[:276] + struct.pack("<ii", 0, 2) + b[284:], "occi_ushort"),
    ],
)
def test_damaged_containers(tmp_path, takes, damage, named):
    path = write_sens(tmp_path / "a.sens", takes)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(SequenceError, match=rf"a\.sens .*{named}"):
        convert(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
