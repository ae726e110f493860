"""ICL-NUIM: the left-handed world, negative fy, and distances along rays."""

import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.recordings.convert import ConvertOptions, convert, detect_format
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=640,
    height=480,
    fx=481.2,
    fy=480.0,
    cx=320.0,
    cy=240.0,
)


@pytest.fixture(scope="module")
def left_handed():
    """A scene made in ICL-NUIM's own convention, without any of our matrices: a box, y up, seen
    with fy = -480.

    Pixel (u, v) of pose (R, t): ray ((u - 319.5) / 481.2, (v - 239.5) / -480, 1), point R (z ray) +
    t.
    """
    half = np.array([2.0, 1.5, 2.5])
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    rays = np.stack(
        [(u - 319.5) / 481.2, (v - 239.5) / -480.0, np.ones_like(u)],
        -1,
    )
    frames = []
    for i in range(1, 3):
        quat = quaternion.normalise(
            torch.tensor([1.0, 0.1, 0.2 + 0.05 * i, -0.05], dtype=torch.float64)
        )
        R = quaternion.to_matrix(quat).numpy()
        t = np.array([0.3, -0.2, 0.1 * i])
        d = rays @ R.T
        z = ((np.sign(d) * half - t) / d).min(-1)
        point = t + z[..., None] * d
        rgb = (127.5 + 100 * np.sin(point * np.array([2.0, 3.0, 2.5]))).astype(np.uint8)
        row = [*t, *quat[[1, 2, 3, 0]].tolist()]
        frames.append((i, rgb, z, row, np.linalg.norm(z[..., None] * rays, axis=-1)))
    return frames, half


def write(root, takes, frames, kind):
    import cv2

    lines = []
    for i, rgb, z, row, distance in frames:
        png = cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()
        if kind == "png":
            takes.write(root / f"rgb/{i}.png", png)
            takes.write(
                root / f"depth/{i}.png",
                cv2.imencode(".png", np.rint(z * 5000).astype(np.uint16))[1].tobytes(),
            )
        else:
            takes.write(root / f"scene_00_{i:04d}.png", png)
            text = " ".join(f"{v:.5f}" for v in distance.flatten())
            takes.write(root / f"scene_00_{i:04d}.depth", text.encode())
        lines.append(" ".join(f"{v:.9f}" for v in (i, *row)))
    (root / "livingRoom1.gt.freiburg").write_text("\n".join(lines))
    return root


@pytest.mark.parametrize("kind", ["png", "depth"])
def test_world_and_camera_become_right_handed(tmp_path, takes, left_handed, kind):
    frames, half = left_handed
    frames = frames if kind == "png" else frames[:1]  # half a million numbers of text each
    root = write(tmp_path / "kt1", takes, frames, kind)
    assert detect_format(root) == "icl_nuim"
    convert(root, tmp_path / "out")
    sequence = folder(tmp_path / "out")
    assert vars(sequence.camera) == pytest.approx(vars(CAMERA))
    from gsfusion_nb.geometry import depth_to_points, se3

    for frame, (_, rgb, z, row, _) in zip(sequence, frames, strict=True):
        assert np.array_equal(frame.rgb_u8.numpy(), rgb)
        assert np.abs(frame.depth_m.numpy() - z).max() < 6e-4
        assert torch.allclose(
            frame.T_WC[:3, 3].double(),
            torch.tensor([row[0], -row[1], row[2]]).double(),
            atol=1e-6,
        )
        point = se3.apply(frame.T_WC.double(), depth_to_points(CAMERA, frame.depth_m).double())
        off = (torch.from_numpy(half) - point.abs()).abs().min(-1).values
        assert float(off.max()) < 2e-3  # on the walls of the mirrored box
        # and the colour belongs to the point, mirrored back: 1 grey level is 4 mm
        mirrored = point.numpy() * np.array([1, -1, 1])
        assert np.abs(127.5 + 100 * np.sin(mirrored * np.array([2.0, 3.0, 2.5])) - rgb).max() < 2


def test_frames_before_the_first_pose_are_dropped(tmp_path, takes, left_handed):
    frames, _ = left_handed
    root = write(tmp_path / "kt1", takes, frames, "png")
    (root / "rgb/0.png").write_bytes((root / "rgb/1.png").read_bytes())
    (root / "depth/0.png").write_bytes((root / "depth/1.png").read_bytes())
    report = convert(root, tmp_path / "out", options=ConvertOptions(width=160))
    assert (report.frames, report.dropped) == (2, {"no pose": 1})
    assert (report.camera.width, report.camera.height) == (160, 120)


def test_mistakes_are_answered_with_a_sentence(tmp_path, takes, left_handed):
    root = write(tmp_path / "kt1", takes, left_handed[0], "png")
    (root / "livingRoom1.gt.freiburg").write_text("1 0 0 0\n")
    with pytest.raises(SequenceError, match=r"gt\.freiburg line 1"):
        convert(root, tmp_path / "out")
    (root / "rgb/1.png").rename(root / "rgb/one.png")
    with pytest.raises(SequenceError, match=r"one\.png is not named by its frame number"):
        convert(root, tmp_path / "out")
