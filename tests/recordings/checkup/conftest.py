"""Recordings on disk, broken in every way that a check-up must name."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.geometry import quaternion

N_FRAMES = 30


@dataclass(frozen=True)
class Recording:
    """A recording in the plain layout, to be changed in place."""

    root: Path

    @property
    def poses(self) -> np.ndarray:
        """[N, 4, 4]"""
        return np.loadtxt(self.root / "poses.txt").reshape(-1, 4, 4)

    @property
    def intrinsics(self) -> dict:
        """Content of intrinsics.json."""
        return json.loads((self.root / "intrinsics.json").read_text())

    def write(self, *, poses: np.ndarray | None = None, **intrinsics) -> None:
        """Replace the poses, or single intrinsics."""
        if poses is not None:
            np.savetxt(self.root / "poses.txt", poses.reshape(-1, 16), fmt="%.9f")
        (self.root / "intrinsics.json").write_text(json.dumps(self.intrinsics | intrinsics))

    def change_images(
        self,
        kind: str,
        change: Callable[[int, list[np.ndarray]], np.ndarray],
    ) -> None:
        """Replace image i by ``change(i, all images)``; ``kind`` is rgb or depth."""
        files = sorted((self.root / kind).iterdir())
        images: list[Any] = [cv2.imread(str(f), cv2.IMREAD_UNCHANGED) for f in files]
        for i, f in enumerate(files):
            options = [cv2.IMWRITE_JPEG_QUALITY, 95] if f.suffix == ".jpg" else []
            assert cv2.imwrite(str(f), change(i, images), options)


@dataclass(frozen=True)
class Breakage:
    """One way to break a recording and what the check-up must say."""

    break_it: Callable[[Recording], None]
    named: set[str]
    """Findings that are not ok."""
    repair: dict = field(default_factory=dict)
    """Fields of the report's ``data.repair`` (or of ``data``): value, or (value, tolerance)."""
    mends: bool = True
    """Whether the repair makes everything ok."""


def _scale_depth(factor: float) -> Callable[[Recording], None]:
    return lambda r: r.write(depth_scale=r.intrinsics["depth_scale"] / factor)


def _poses(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recording], None]:
    return lambda r: r.write(poses=np.stack([change(T) for T in r.poses]))


def _intrinsics(change: Callable[[dict], dict]) -> Callable[[Recording], None]:
    return lambda r: r.write(**change(r.intrinsics))


def _wxyz_as_xyzw(T: np.ndarray) -> np.ndarray:
    w, x, y, z = quaternion.from_matrix(torch.from_numpy(T[:3, :3])).tolist()
    T = T.copy()
    T[:3, :3] = quaternion.to_matrix(torch.tensor([z, w, x, y], dtype=torch.float64)).numpy()
    return T


def _later(k: int) -> Callable[[Recording], None]:
    """Poses of k frames later."""
    return lambda r: r.write(
        poses=r.poses[
            np.clip(
                np.arange(len(r.poses)) + k,
                0,
                len(r.poses) - 1,
            )
        ]
    )


def _moved_colour(
    x: float,
    y: float,
    scale: float,
) -> Callable[[Recording], None]:
    def change(i: int, images: list[np.ndarray]) -> np.ndarray:
        h, w = images[i].shape[:2]
        k = w / 640
        matrix = np.array(
            [
                [scale, 0, (1 - scale) * (w - 1) / 2 + k * x],
                [0, scale, (1 - scale) * (h - 1) / 2 + k * y],
            ]
        )
        return cv2.warpAffine(images[i], matrix, (w, h), borderMode=cv2.BORDER_REPLICATE)

    return lambda r: r.change_images("rgb", change)


def _ray_depth(r: Recording) -> None:
    k = r.intrinsics
    u, v = np.meshgrid(np.arange(k["width"]), np.arange(k["height"]))
    length = np.sqrt(1 + ((u - k["cx"]) / k["fx"]) ** 2 + ((v - k["cy"]) / k["fy"]) ** 2)
    r.change_images(
        "depth",
        lambda i, d: np.rint(d[i] * length).clip(0, 65535).astype(np.uint16),
    )


def _coded(i: int, depth: list[np.ndarray]) -> np.ndarray:
    changed = depth[i].copy()
    changed[: len(changed) // 8, :: 1 + i % 3] = 65535
    changed[changed == 0] = 65535
    return changed


def _spike(r: Recording) -> None:
    poses = r.poses
    poses[12, :3, 3] += [0.5, -0.3, 0.4]
    r.write(poses=poses)


def _broken_path(r: Recording) -> None:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, 0.6]))[0]
    turn[:3, 3] = 0.7
    poses = r.poses
    poses[20:] = turn @ poses[20:]
    r.write(poses=poses)


def _exposure(i: int, rgb: list[np.ndarray]) -> np.ndarray:
    gain = 0.55 if i // 5 % 2 else 1.0
    return (((rgb[i] / 255.0) ** 2.2 * gain) ** (1 / 2.2) * 255).astype(np.uint8)


def _blur(i: int, rgb: list[np.ndarray]) -> np.ndarray:
    return cv2.blur(rgb[i], (max(9, rgb[i].shape[1] // 40),) * 2) if i in (7, 18) else rgb[i]


def _freeze(r: Recording) -> None:
    for folder in ("rgb", "depth"):
        files = sorted((r.root / folder).iterdir())
        for i in (10, 11):
            shutil.copy(files[9], files[i])


def _other_size(r: Recording) -> None:
    k = r.intrinsics
    r.write(
        **{n: 2 * k[n] for n in ("width", "height", "fx", "fy")},
        cx=2 * k["cx"] + 0.5,
        cy=2 * k["cy"] + 0.5,
    )


def _colour_ahead(r: Recording) -> None:
    r.change_images(
        "rgb",
        lambda i, c: c[min(i + 2, len(c) - 1)],
    )
    for folder in ("rgb", "depth"):
        for f in sorted((r.root / folder).iterdir())[-2:]:
            f.unlink()
    r.write(poses=r.poses[:-2])


_GL = np.diag([1.0, -1, -1, 1])
_ROS = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_MIRROR = np.diag([1.0, -1, 1, 1])

BREAKAGES = {
    "clean": Breakage(lambda r: None, set()),
    "depth 5000 as 1000": Breakage(_scale_depth(5), {"depth scale"}, {"depth_factor": 0.2}),
    "depth 4 % off": Breakage(
        _scale_depth(1.04), {"depth scale"}, {"depth_factor": (1 / 1.04, 0.012)}
    ),
    "mm poses": Breakage(
        _poses(lambda T: T * np.array([[1, 1, 1, 1000.0]] * 3 + [[1, 1, 1, 1]])),
        {"depth scale"},
        {"translation_factor": 0.001},
    ),
    "inverted": Breakage(_poses(np.linalg.inv), {"pose direction"}, {"poses": "world_to_camera"}),
    "opengl": Breakage(
        _poses(lambda T: T @ _GL),
        {"pose axes"},
        {"axes": "opengl"},
    ),
    "ros": Breakage(
        _poses(lambda T: T @ _ROS.T),
        {"pose axes"},
        {"axes": "ros"},
    ),
    "unity": Breakage(
        _poses(lambda T: _MIRROR @ T @ _MIRROR),
        {"pose axes"},
        {"axes": "unity"},
    ),
    "opengl view matrices": Breakage(
        _poses(lambda T: np.linalg.inv(T @ _GL)),
        {"pose direction", "pose axes"},
        {"poses": "world_to_camera", "axes": "opengl"},
    ),
    "wxyz": Breakage(_poses(_wxyz_as_xyzw), {"quaternion order"}, {"quaternions": "wxyz"}),
    "pose jump": Breakage(_spike, {"pose jumps"}, {"skip": (12,)}),
    "path is interrupted": Breakage(_broken_path, {"pose jumps"}, {"start": 0, "stop": 20}),
    "poses early": Breakage(_later(-1), {"pose time"}, {"pose_shift_frames": 1.0}),
    "poses late": Breakage(_later(2), {"pose time"}, {"pose_shift_frames": -2.0}),
    "focal": Breakage(
        _intrinsics(lambda k: {n: 1.08 * k[n] for n in ("fx", "fy")}),
        {"focal length"},
        {"fx": ("fx", 0.01), "fy": ("fy", 0.01)},
    ),
    "cx cy": Breakage(
        _intrinsics(lambda k: {"cx": k["cy"], "cy": k["cx"]}),
        {"principal point"},
        {"cx": ("cx", 0.02), "cy": ("cy", 0.02)},
    ),
    "half intrinsics": Breakage(
        _intrinsics(lambda k: {n: k[n] / 2 for n in ("fx", "fy", "cx", "cy")}),
        {"focal length", "principal point"},
        {"fx": ("fx", 0.01), "cx": ("cx", 0.02)},
    ),
    "other size": Breakage(_other_size, {"image size"}, {"fit_sizes": True}),
    "half a pixel": Breakage(
        lambda r: r.write(pixel_centre=0.5),
        {"pixel centres"},
        {"pixel_shift": 0.5},
    ),
    "ray depth": Breakage(_ray_depth, {"depth kind"}, {"depth_kind": "ray"}),
    "65535": Breakage(
        lambda r: r.change_images("depth", _coded),
        {"depth codes"},
        {"depth_max_m": ("code", 0.02)},
    ),
    "colour moved": Breakage(
        _moved_colour(10, -6, 1.0),
        {"registration"},
        {"rgb_shift_x_px": (10, 2.0), "rgb_shift_y_px": (-6, 2.0)},
    ),
    "other camera": Breakage(
        _moved_colour(-12, 4, 0.91), {"registration"}, {"rgb_scale": (0.91, 0.015)}
    ),
    "mirrored": Breakage(
        lambda r: r.change_images("rgb", lambda i, c: c[i][:, ::-1]),
        {"registration"},
        {"rgb_mirror": "x"},
    ),
    "colour ahead": Breakage(_colour_ahead, {"colour time"}, {"rgb_shift_frames": -2}),
    "mixed up": Breakage(
        lambda r: r.change_images("rgb", lambda i, c: c[(i * 7 + 3) % len(c)]),
        {"registration"},
        mends=False,
    ),
    "exposure": Breakage(
        lambda r: r.change_images("rgb", _exposure),
        {"exposure"},
        mends=False,
    ),
    "blur": Breakage(
        lambda r: r.change_images("rgb", _blur),
        {"sharpness"},
        {"skip": (7, 18)},
    ),
    "frozen": Breakage(_freeze, {"frozen frames"}, {"skip": (10, 11)}),
}

ROOM_SIZES = {"room": (320, 240), "small room": (160, 120)}
SOURCES = {
    "redkitchen250": 200,
    "livingroom1_clean211": 100,
    "redkitchen_mini48": 0,
}
"""Recording -> first of the frames copied."""


def write_clean(source: str, root: Path, folder: Path | None) -> Recording:
    """Thirty frames of the room or of a recording in ``folder``, in the plain layout."""
    for kind in ("rgb", "depth"):
        (root / kind).mkdir(parents=True)
    if folder is None:
        return _write_room(root, *ROOM_SIZES[source])
    first = SOURCES[source]
    for kind in ("rgb", "depth"):
        for i, f in enumerate(sorted((folder / kind).iterdir())[first : first + N_FRAMES]):
            shutil.copy(f, root / kind / f"{i:06d}{f.suffix}")
    recording = Recording(root)
    (root / "intrinsics.json").write_text((folder / "intrinsics.json").read_text())
    recording.write(
        poses=np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)[first : first + N_FRAMES]
    )
    return recording


def _write_room(root: Path, width: int, height: int) -> Recording:
    from gsfusion_nb.data.room import room

    sequence = room(n_frames=200, width=width, height=height)
    for i in range(N_FRAMES):
        frame = sequence[i]
        cv2.imwrite(
            str(root / f"rgb/{i:06d}.jpg"),
            frame.rgb_u8.numpy()[..., ::-1],
            [cv2.IMWRITE_JPEG_QUALITY, 95],
        )
        cv2.imwrite(
            str(root / f"depth/{i:06d}.png"),
            np.rint(frame.depth_m.numpy() * 5000).astype(np.uint16),
        )
    c = sequence.camera
    values = {
        "width": c.width,
        "height": c.height,
        "fx": c.fx,
        "fy": c.fy,
        "cx": c.cx - 0.5,
        "cy": c.cy - 0.5,
    }
    (root / "intrinsics.json").write_text(json.dumps(values | {"depth_scale": 5000.0}))
    recording = Recording(root)
    recording.write(poses=np.stack([sequence[i].T_WC.double().numpy() for i in range(N_FRAMES)]))
    return recording


@pytest.fixture(scope="session")
def clean_recordings(tmp_path_factory):
    """``clean_recordings(source, folder)`` is a clean copy, written once."""
    known: dict[str, Recording] = {}

    def get(source: str, folder: Path | None) -> Recording:
        if source not in known:
            known[source] = write_clean(source, tmp_path_factory.mktemp(source), folder)
        return known[source]

    return get


@pytest.fixture
def broken(tmp_path, clean_recordings, request):
    """``broken(source, breakage)`` is a copy broken so, and the clean one's intrinsics."""

    def get(source: str, breakage: str) -> tuple[Recording, dict]:
        folder = (
            None if source in ROOM_SIZES else request.getfixturevalue("shared_sequence")(source)
        )
        clean = clean_recordings(source, folder)
        root = tmp_path / "scan"
        shutil.copytree(clean.root, root)
        recording = Recording(root)
        BREAKAGES[breakage].break_it(recording)
        return recording, clean.intrinsics

    return get


@pytest.fixture
def breakages():
    """All breakages by name."""
    return BREAKAGES
