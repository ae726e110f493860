"""COLMAP models, text and binary, byte for byte as COLMAP writes them."""

import struct

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError, SequenceNotFoundError, folder
from gsfusion_nb.data.lens import CameraModel
from gsfusion_nb.geometry import backproject, project, quaternion, se3
from gsfusion_nb.recordings.convert import ConvertOptions, convert, detect_format
from gsfusion_nb.types import Camera

UNIT_M = 0.37
"""Metres per unit of the reconstruction."""
IDS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
}


def poses(takes):
    """wxyz and translation of world-to-camera in the reconstruction's unit, out of order as
    COLMAP's are."""
    T_CW = se3.inverse(takes.T_WC)
    rows = torch.cat(
        [quaternion.from_matrix(T_CW[:, :3, :3]), T_CW[:, :3, 3] / UNIT_M],
        dim=1,
    ).tolist()
    return [(i, rows[i]) for i in (2, 0, 3, 1) if i < len(rows)]


def sparse_points(takes, i):
    """Pixels of a frame and their points in the reconstruction's unit."""
    c = takes.camera
    uv = torch.tensor(
        [[x + 0.5, y + 0.5] for x in range(3, c.width, 9) for y in range(3, c.height, 9)]
    ).double()
    depth = torch.from_numpy(takes.depth_m[i]).double()[uv[:, 1].long(), uv[:, 0].long()]
    return uv.tolist(), (se3.apply(takes.T_WC[i], backproject(c, uv, depth)) / UNIT_M).tolist()


def write_colmap(root, takes, suffix, *, model="PINHOLE", params=None, points=True):
    c = takes.camera
    params = params or [c.fx, c.fy, c.cx, c.cy]
    sparse = root / "sparse/0"
    sparse.mkdir(parents=True)
    seen = {i: sparse_points(takes, i) for i in range(len(takes))}
    (write_txt if suffix == ".txt" else write_bin)(
        sparse, takes, (IDS[model], model, params), seen, points
    )
    for i in range(len(takes)):
        takes.write(root / f"images/left/frame{i + 8}.png", takes.png(i))
        takes.write(root / f"depth/left/frame{i + 8}.png", takes.depth_png(i))
    return root


def test_of_several_models_the_largest_is_taken(tmp_path, takes):
    root = write_colmap(tmp_path / "scan", takes, ".bin")
    (root / "sparse/0").rename(root / "sparse/1")
    part = type(takes)(
        takes.camera,
        takes.rgb[:3],
        takes.depth_m[:3],
        takes.T_WC[:3],
        takes.times_s[:3],
    )
    write_colmap(tmp_path / "part", part, ".txt")
    (tmp_path / "part/sparse/0").rename(root / "sparse/0")
    report = convert(root, tmp_path / "out", options=ConvertOptions(scale=UNIT_M))
    assert report.frames == 4
    assert any(
        "sparse/1 is the largest model, of 4 images" in note and "sparse/0 has 3" in note
        for note in report.notes
    )
    assert (
        convert(
            root / "sparse/0", tmp_path / "other", options=ConvertOptions(depth=str(root / "depth"))
        ).frames
        == 3
    )


def write_txt(sparse, takes, camera, seen, points):
    c = takes.camera
    text = f"# Camera list\n1 {camera[1]} {c.width} {c.height} {' '.join(map(repr, camera[2]))}\n"
    (sparse / "cameras.txt").write_text(text)
    lines = ["# Image list with two lines of data per image:"]
    rows = ["# 3D point list"]
    n = 0
    for i, pose in poses(takes):
        lines.append(f"{i + 1} {' '.join(map(repr, pose))} 1 left/frame{i + 8}.png")
        line = ["7.0 7.0 -1"]
        for k, ((x, y), p) in enumerate(zip(*seen[i], strict=True), 1):
            line.append(f"{x} {y} {n}")
            rows.append(f"{n} {p[0]} {p[1]} {p[2]} 10 20 30 0.5 {i + 1} {k}")
            n += 1
        lines.append(" ".join(line) if points else "")
    (sparse / "images.txt").write_text("\n".join([*lines, ""]))
    if points:
        (sparse / "points3D.txt").write_text("\n".join([*rows, ""]))


def write_bin(sparse, takes, camera, seen, points):
    c = takes.camera
    head = struct.pack(
        "<QIiQQ",
        1,
        1,
        camera[0],
        c.width,
        c.height,
    )
    (sparse / "cameras.bin").write_bytes(head + struct.pack(f"<{len(camera[2])}d", *camera[2]))
    images = struct.pack("<Q", len(takes))
    rows = b""
    n = 0
    for i, pose in poses(takes):
        images += struct.pack("<I7dI", i + 1, *pose, 1) + f"left/frame{i + 8}.png".encode() + b"\0"
        seen_here = list(zip(*seen[i], strict=True)) if points else []
        images += struct.pack("<Q", len(seen_here) + 1) + struct.pack("<ddQ", 7.0, 7.0, 2**64 - 1)
        for k, ((x, y), p) in enumerate(seen_here, 1):
            images += struct.pack("<ddQ", x, y, n)
            rows += struct.pack(
                "<QdddBBBdQII",
                n,
                *p,
                10,
                20,
                30,
                0.5,
                1,
                i + 1,
                k,
            )
            n += 1
    (sparse / "images.bin").write_bytes(images)
    if points:
        (sparse / "points3D.bin").write_bytes(struct.pack("<Q", n) + rows)


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_reads_what_was_written_and_measures_the_scale(tmp_path, takes, suffix):
    root = write_colmap(tmp_path / "scan", takes, suffix)
    assert detect_format(root) == "colmap"
    report = convert(root, tmp_path / "out")
    takes.check(tmp_path / "out", pose=2e-4)  # the scale is measured on depth of 1 mm steps
    note = next(n for n in report.notes if "no unit of length" in n)
    assert "measured on 140 sparse points" in note
    assert float(note.split("taken as ")[1].split()[0]) == pytest.approx(UNIT_M, rel=1e-4)


def test_images_that_are_named_outside_of_the_folder_are_told(tmp_path, takes):
    root = write_colmap(tmp_path / "scan", takes, ".txt")
    listed = root / "sparse/0/images.txt"
    listed.write_text(listed.read_text().replace("left/frame8.png", "../../elsewhere/frame8.jpg"))
    takes.write(tmp_path / "elsewhere/frame8.jpg", takes.png(0))
    takes.write(tmp_path / "elsewhere/frame8.png", takes.depth_png(0))
    report = convert(root, tmp_path / "out")
    note = next(n for n in report.notes if "lie outside" in n)
    assert note.startswith("1 of the listed images lie outside of")
    assert str(tmp_path / "elsewhere/frame8.jpg") in note
    takes.check(tmp_path / "out", pose=2e-4)


def test_inverse_depth_is_refused(tmp_path, takes):
    """As prepared for the depth regularisation of 3D Gaussian splatting; and without the file that
    says so."""
    root = write_colmap(tmp_path / "scan", takes, ".txt")
    (root / "depth").rename(root / "depths")
    for i in range(len(takes)):
        inverse = np.where(
            takes.depth_m[i] > 0,
            1 / np.maximum(takes.depth_m[i], 0.1),
            0,
        )
        file = root / f"depths/left/frame{i + 8}.png"
        cv2.imwrite(
            str(file),
            np.rint(inverse / inverse.max() * 60000).astype(np.uint16),
        )
    params = root / "sparse/0/depth_params.json"
    params.write_text("{}")
    with pytest.raises(
        SequenceError, match=r"depth_params\.json says that .*depths holds inverse depth"
    ):
        convert(root, tmp_path / "out")
    params.unlink()
    with pytest.raises(
        SequenceError, match=r"does not hold the depth of this model: .* must within 30 %"
    ):
        convert(root, tmp_path / "out")


def test_scale_can_be_given(tmp_path, takes):
    root = write_colmap(tmp_path / "scan", takes, ".bin", points=False)
    convert(root, tmp_path / "out", options=ConvertOptions(scale=UNIT_M))
    takes.check(tmp_path / "out")


# parameters after fx fy cx cy, and the same in OpenCV's order
BENT = {
    "OPENCV": ([-0.2, 0.05, 0.003, -0.002], (-0.2, 0.05, 0.003, -0.002)),
    "FULL_OPENCV": (
        [-0.2, 0.05, 0.003, -0.002, 0.01, 0.02, 0.0, 0.0],
        (-0.2, 0.05, 0.003, -0.002, 0.01, 0.02, 0.0, 0.0),
    ),
    "OPENCV_FISHEYE": ([0.05, -0.01, 0.002, 0.0], (0.05, -0.01, 0.002, 0.0)),
}


@pytest.mark.parametrize("model", list(BENT))
def test_distortion_is_removed(tmp_path, takes, box, model):
    """A picture whose colours are a smooth function of the point on the wall, taken through the
    lens."""
    c = Camera(
        width=160,
        height=120,
        fx=120.0,
        fy=118.0,
        cx=78.0,
        cy=61.0,
    )
    params, D = BENT[model]
    lens = CameraModel(c, D, model == "OPENCV_FISHEYE")
    wide = Camera(
        width=640,
        height=480,
        fx=200.0,
        fy=200.0,
        cx=320.0,
        cy=240.0,
    )
    rgb, depth_m = box.render(box.pose_at(0.0), wide)
    u, v = np.meshgrid(np.arange(c.width) + 0.5, np.arange(c.height) + 0.5)
    rays = unproject_witness(
        np.stack([u, v], -1),
        c,
        np.array(D),
        lens.fisheye,
    )
    at = project(wide, torch.from_numpy(rays)).float().numpy() - 0.5
    bent_rgb = cv2.remap(
        rgb,
        at[..., 0].copy(),
        at[..., 1].copy(),
        cv2.INTER_LINEAR,
    )
    bent_z = cv2.remap(
        depth_m.astype(np.float32),
        at[..., 0].copy(),
        at[..., 1].copy(),
        cv2.INTER_LINEAR,
    )
    one = type(takes)(
        c,
        [bent_rgb] * 4,
        [bent_z] * 4,
        box.pose_at(0.0).expand(4, 4, 4),
        takes.times_s,
    )
    root = write_colmap(
        tmp_path / "scan",
        one,
        ".bin",
        model=model,
        params=[c.fx, c.fy, c.cx, c.cy, *params],
    )
    convert(root, tmp_path / "out", options=ConvertOptions(scale=UNIT_M))
    frame = folder(tmp_path / "out")[0]
    straight, z = box.render(box.pose_at(0.0), frame.camera)
    # measured 0.6; 6 and more if bent
    assert np.abs(frame.rgb_u8.numpy().astype(int) - straight).mean() < 1.5
    # nearest pixel of a 1.3 px/degree image
    assert np.median(np.abs(frame.depth_m.numpy() - z)) < 0.006
    assert box.off_wall_m(frame) < 0.006


def unproject_witness(uv, c, D, fisheye):
    """Rays of pixels by fixed-point iteration on the published formulas, without OpenCV."""
    xd = np.stack(
        [(uv[..., 0] - c.cx) / c.fx, (uv[..., 1] - c.cy) / c.fy],
        -1,
    )
    xy = xd.copy()
    D = np.concatenate([D, np.zeros(8 - len(D))])
    for _ in range(200):
        r2 = (xy**2).sum(-1)
        if fisheye:
            r = np.sqrt(r2) + 1e-12
            t = np.arctan(r)
            factor = t * (1 + D[0] * t**2 + D[1] * t**4 + D[2] * t**6 + D[3] * t**8) / r
            xy = xd / factor[..., None]
            continue
        factor = (1 + D[0] * r2 + D[1] * r2**2 + D[4] * r2**3) / (
            1 + D[5] * r2 + D[6] * r2**2 + D[7] * r2**3
        )
        x = xy[..., 0]
        y = xy[..., 1]
        tangential = np.stack(
            [
                2 * D[2] * x * y + D[3] * (r2 + 2 * x * x),
                D[2] * (r2 + 2 * y * y) + 2 * D[3] * x * y,
            ],
            -1,
        )
        xy = (xd - tangential) / factor[..., None]
    return np.concatenate([xy, np.ones_like(xy[..., :1])], -1)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
@pytest.mark.parametrize("keep", [4, 30, 0.97])
def test_truncated_binaries(tmp_path, takes, name, keep):
    root = write_colmap(tmp_path / "scan", takes, ".bin")
    whole = (root / "sparse/0" / name).read_bytes()
    (root / "sparse/0" / name).write_bytes(whole[: keep if keep > 1 else int(keep * len(whole))])
    with pytest.raises(SequenceError, match=rf"{name} is truncated: it ends.*copy it again"):
        convert(root, tmp_path / "out")


def test_depth_elsewhere(tmp_path, takes):
    root = write_colmap(tmp_path / "d", takes, ".txt")
    (root / "depth").rename(root / "elsewhere")
    with pytest.raises(SequenceNotFoundError, match="--depth"):
        convert(root, tmp_path / "out")
    convert(root, tmp_path / "out", options=ConvertOptions(depth=str(root / "elsewhere")))
    takes.check(tmp_path / "out", pose=2e-4)  # the scale is measured on depth of 1 mm steps
