"""A ScanNet++ scene from its licensed copy: fisheye photographs and a mesh become what the reader takes."""

import json

import cv2
import numpy as np
import torch

from gsfusion_nb.data.lens import CameraModel
from gsfusion_nb.data.readers import scannetpp
from gsfusion_nb.recordings.convert.scannetpp_scene import HalfSizePinhole, mesh_in_transforms_world, prepare_scene
from gsfusion_nb.types import Camera, Mesh

HALF_SIZE_M = np.array([2.0, 1.5, 2.5])
LENS = CameraModel(
    Camera(width=192, height=128, fx=88.0, fy=88.5, cx=95.2, cy=64.9), (0.05, -0.02, 0.01, -0.003), fisheye=True
)
NAMES = ["DSC00002.JPG", "DSC00001.JPG", "DSC00003.JPG"]


def box_mesh() -> Mesh:
    """The box room's walls, in the scan's world: the transforms' world with x and y swapped and z negated."""
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * HALF_SIZE_M
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    vertices = torch.from_numpy(corners[:, [1, 0, 2]] * [1, 1, -1]).float()
    return Mesh(vertices_W=vertices, faces=torch.tensor(faces), rgb=torch.zeros(8, 3))


def fisheye_picture(T_WC, lens=LENS):
    """The box's pattern along the fisheye's own rays."""
    c = lens.camera
    u, v = np.meshgrid(np.arange(c.width, dtype=float), np.arange(c.height, dtype=float))
    K = c.K.numpy().copy()
    K[:2, 2] -= 0.5
    x = cv2.fisheye.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), K, np.array(lens.distortion))
    ray = np.concatenate([x.reshape(c.height, c.width, 2), np.ones((c.height, c.width, 1))], -1)
    T = T_WC.numpy()
    d, o = ray @ T[:3, :3].T, T[:3, 3]
    t = ((np.sign(d) * HALF_SIZE_M - o) / d).min(-1)
    point = o + t[..., None] * d
    return (127.5 + 100 * np.sin(point * np.array([2.0, 3.0, 2.5]))).astype(np.uint8)


def write_copy(scene, box):
    """The layout of a scene as it is handed out."""
    dslr = scene / "dslr"
    frames = []
    for name in NAMES:
        T = box.poses(9)[2 * int(name[3:8])]
        box.write_rgb(dslr / "resized_images" / name.replace("JPG", "jpg"), fisheye_picture(T))
        (dslr / "resized_images" / name.replace("JPG", "jpg")).rename(dslr / "resized_images" / name)
        matrix = T.numpy() @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": name, "mask_path": "x.png", "transform_matrix": matrix.tolist(), "is_bad": False})
    c = LENS.camera
    values = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
    values |= {"camera_model": "OPENCV_FISHEYE", **{f"k{i}": k for i, k in enumerate(LENS.distortion, 1)}}
    values |= {"frames": frames[:2], "test_frames": frames[2:]}
    (dslr / "nerfstudio").mkdir()
    (dslr / "nerfstudio/transforms.json").write_text(json.dumps(values))
    (dslr / "train_test_lists.json").write_text(json.dumps({"train": NAMES[:2], "test": NAMES[2:]}))
    return scene


def check(sequence, box):
    assert len(sequence) == 3
    assert sequence.novel == {2}
    for frame, name in zip(sequence, NAMES, strict=True):
        T = box.poses(9)[2 * int(name[3:8])]
        assert torch.allclose(frame.T_WC.double(), T, atol=1e-6)
        assert bool((frame.depth_m > 0).all())
        assert box.off_wall_m(frame) < 0.0005  # depth is rounded to millimetres
        expected, depth_m = box.render(T, frame.camera)
        assert np.abs(depth_m - frame.depth_m.numpy()).max() < 0.00051
        error = np.abs(frame.rgb.numpy() * 255 - expected)
        assert np.median(error) < 2
        assert np.quantile(error, 0.99) < 10


def test_fisheye_scene(tmp_path, box):
    scene = write_copy(tmp_path / "8b5caf3398", box)
    prepare_scene(scene, box_mesh(), tmp_path / "new")
    sequence = scannetpp(tmp_path / "new")
    assert (sequence.camera.width, sequence.camera.height) == (96, 64)
    assert (sequence.camera.cx, sequence.camera.cy) == (48, 32)
    check(sequence, box)


def test_the_mesh_is_turned_not_mirrored():
    mesh = Mesh(vertices_W=torch.eye(3), faces=torch.tensor([[0, 1, 2]]), rgb=torch.zeros(3, 3))
    R = mesh_in_transforms_world(mesh).vertices_W.T
    assert torch.linalg.det(R) == 1
    assert torch.equal(R @ torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 1.0, -3.0]))


def test_the_pinhole_sees_nothing_outside_the_fisheye():
    half = HalfSizePinhole(LENS)
    white = np.full((128, 192, 3), 255, np.uint8)
    u, v = half._map
    assert -2 < u.min() < u.max() < 193
    assert -2 < v.min() < v.max() < 130
    assert (half(white) == 255).all()
