"""The built-in room as a sequence of frames, rendered when they are asked for."""

import dataclasses
import functools
import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...checks import check_number, check_pose
from ...errors import ArgumentError
from ...files import cache_folder
from ...geometry import backproject, pixel_grid, se3
from ...resources import MAP_MEMORY
from ...types import Camera, Frame, Mesh
from . import raycast, shade
from .building_walk import BuildingWalk
from .camera import TRAJECTORIES, exposed, exposure_gains, without_depth
from .depth_noise import kinect_depth, stereo_depth
from .image_cache import cached
from .interior import MOVED
from .scene import load_scene, place_of, version
from .surface import room_mesh

_FOCAL_PER_WIDTH = 0.65
"""A horizontal field of view of 75 degrees."""

_DEPTH_UNIT_M = 1e-4
"""Stored depth counts tenths of a millimetre in uint16, up to 6.55 m: the farthest z-depth in the
room is 6.41 m."""

NOISES = ("none", "kinect", "stereo")
"""Errors of depth that a room can have."""

_IMPERFECT = {
    "exposure_stops": 3,
    "pose_error_m": 0.2,
    "pose_error_deg": 10,
    "pose_delay_s": 5,
    "holes": 1,
}
"""Options that add the mistakes of a recording, and their largest values. They come after the
cache."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RoomSequence:
    """The built-in scene: a furnished room of 5 x 4 x 2.6 m, seen by a hand-held camera that walks
    through it.

    World frame: z up, origin on the floor in the middle of the room, metres. Everything is
    procedural; the same options give the same frames. Colour has 8 bits and depth has steps of 0.1
    mm, whether a frame is rendered or read from the cache (``$GSFUSION_CACHE``, or the user's cache
    folder). Noise is added after the cache. ``room`` is the same class.

    Raises:
        ValueError: an option outside its range. IndexError: no such frame.
    """

    n_frames: int = 200
    """Number of frames of a room, spread over the same walk of about a minute: fewer frames are
    farther apart."""
    rooms: int = 1
    """Number of rooms: a square building of equal rooms, 10 m apart, which are walked through one
    after another."""
    width: int = 640
    height: int = 480
    trajectory: str = "mapping"
    """"mapping" sees the whole room; "novel" is another path through it, for views that were never
    mapped."""
    noise: str = "none"
    """"none": exact depth; "kinect": with the errors of a Kinect; "stereo": with those of a stereo
    camera, such as a RealSense D435."""
    exposure_stops: float = 0.0
    """Auto exposure: the brightness wanders by this many stops (standard deviation), white balance
    by a fifth."""
    pose_error_m: float = 0.0
    """The poses that are given wander about the true ones by this much in each direction (standard
    deviation)."""
    pose_error_deg: float = 0.0
    """The same for their rotation about each axis."""
    pose_delay_s: float = 0.0
    """Poses and images are not of the same time: an image comes with the pose that the camera has
    this much later."""
    holes: float = 0.0
    """Share of the room's surface that never gives depth, 0 to 1, in pieces of up to 40 cm."""
    moved: str = "none"
    """What stands elsewhere than in the room as it is: "none", or "chair", the yellow one."""
    seed: int = 0
    """Seed of the scene, the hand's tremor and everything random."""
    cache: bool = True
    """Store rendered frames on disk."""

    def __post_init__(self):
        for name, least in (
            ("n_frames", 1),
            ("rooms", 1),
            ("width", 8),
            ("height", 8),
            ("seed", 0),
        ):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ArgumentError(
                    f"room: {name} must be a whole number >= {least}, got {value!r}"
                )
        for name, choices in (
            ("trajectory", tuple(TRAJECTORIES)),
            ("noise", NOISES),
            ("moved", MOVED),
        ):
            if getattr(self, name) not in choices:
                raise ArgumentError(
                    f"room: {name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        for name, most in _IMPERFECT.items():
            check_number(f"room: {name}", getattr(self, name), 0, most)

    @property
    def name(self) -> str:
        """Name for reports."""
        return "room" if self.trajectory == "mapping" else f"room-{self.trajectory}"

    @functools.cached_property
    def camera(self) -> Camera:
        """Intrinsics of every frame."""
        focal = _FOCAL_PER_WIDTH * self.width
        return Camera(
            width=self.width,
            height=self.height,
            fx=focal,
            fy=focal,
            cx=self.width / 2,
            cy=self.height / 2,
        )

    def pose(self, i: int) -> Float[Tensor, "4 4"]:
        """Camera-to-world pose of frame ``i`` as it is given, without rendering it."""
        return torch.from_numpy(self._walk.given_poses[self._index(i)]).float()

    def true_pose(self, i: int) -> Float[Tensor, "4 4"]:
        """Camera-to-world pose that frame ``i`` was taken at: ``pose(i)`` without its error and
        delay."""
        return torch.from_numpy(self._walk.poses[self._index(i)]).float()

    def mesh(self) -> Mesh:
        """Ground truth of the surface, 3 cm triangles."""
        room = room_mesh(0.03, seed=self.seed, moved=self.moved, cache=self.cache)
        device = torch.device("cpu")
        n = len(room.vertices_W)
        m = len(room.faces)
        vertices_W, rgb = (MAP_MEMORY.rows(self.rooms * n, 3, device=device) for _ in range(2))
        faces = MAP_MEMORY.rows(
            self.rooms * m,
            3,
            dtype=room.faces.dtype,
            device=device,
        )
        for k, away_m in enumerate(torch.from_numpy(self._walk.rooms_W).float()):
            vertices_W[k * n : (k + 1) * n] = room.vertices_W + away_m
            rgb[k * n : (k + 1) * n] = room.rgb
            faces[k * m : (k + 1) * m] = room.faces + k * n
            MAP_MEMORY.give_back()
        return Mesh(vertices_W=vertices_W, faces=faces, rgb=rgb)

    @property
    def times_s(self) -> np.ndarray:
        """Time of every frame, seconds. [N]"""
        return self._walk.times_s

    @property
    def content(self) -> str:
        """A text that decides all frames: every option, and the version of the scene."""
        return repr(self._options() | {"cache": "", "version": version()})

    def _options(self) -> dict[str, Any]:
        """All options; a room in which nothing was moved has the names that it always had."""
        options = dataclasses.asdict(self)
        if self.moved == "none":
            del options["moved"]
        return options

    def moments(self, frames: range) -> list[str]:
        """What the walk from the first to the last of ``frames`` shows, as one text for each frame
        and each tenth of a second: equal for all rooms with this seed and walk, whatever their
        number of frames, size, noise and errors."""
        times_s = self.times_s[: self.n_frames]
        name = f"room {self.seed}{place_of(self.moved)}, {self.trajectory}"
        texts = [f"{name}, {times_s[i % self.n_frames]:.3f} s" for i in frames]
        # all look the same
        for room in range(frames[0] // self.n_frames, frames[-1] // self.n_frames + 1):
            room_frames = [i - room * self.n_frames for i in frames if i // self.n_frames == room]
            first, last = (10 * times_s[i] for i in (room_frames[0], room_frames[-1]))
            texts += [
                f"{name}, {tenth} tenths" for tenth in range(math.ceil(first), math.floor(last) + 1)
            ]
        return list(dict.fromkeys(texts))

    def __len__(self) -> int:
        return self.rooms * self.n_frames

    def __getitem__(self, i: int) -> Frame:
        i = self._index(i)
        of_room = i % self.n_frames
        images = cached(
            self._path(of_room) if self.cache else None,
            lambda: self._render(of_room),
            functools.partial(_have_size, (self.height, self.width)),
        )
        depth_m = torch.from_numpy(images["depth"].astype(np.float32) * np.float32(_DEPTH_UNIT_M))
        rgb = images["rgb"]
        hole = self._without_depth(depth_m, i)
        if self.noise != "none":
            depth_m = self._measured(depth_m, rgb, i)
        if hole is not None:
            depth_m[hole] = 0.0
        if self.exposure_stops:
            rgb = exposed(rgb, exposure_gains(self.times_s, self.exposure_stops, self.seed)[i])
        return Frame(
            index=i,
            timestamp_s=float(self.times_s[i]),
            rgb=torch.from_numpy(rgb),
            depth_m=depth_m,
            camera=self.camera,
            T_WC=self.pose(i),
        )

    def _measured(self, depth_m: Tensor, rgb: np.ndarray, i: int) -> Tensor:
        """Depth with the errors of the camera, each frame with random numbers of its own."""
        rng = np.random.default_rng([self.seed, 3, i])
        if self.noise == "kinect":
            return kinect_depth(depth_m, self.camera, rng=rng)
        return stereo_depth(depth_m, torch.from_numpy(rgb), self.camera, rng=rng)

    @functools.cached_property
    def _walk(self) -> BuildingWalk:
        fields = dataclasses.fields(BuildingWalk)
        return BuildingWalk(**{field.name: getattr(self, field.name) for field in fields})

    def _without_depth(
        self,
        depth_m: Float[Tensor, "H W"],
        i: int,
    ) -> Bool[Tensor, "H W"] | None:
        if not self.holes:
            return None
        xyz_W = se3.apply(
            self.true_pose(i), backproject(self.camera, pixel_grid(self.camera), depth_m)
        )
        return torch.from_numpy(without_depth(xyz_W.numpy(), self.holes, self.seed))

    @functools.cached_property
    def _folder(self) -> Path:
        walk_W = self._walk.poses[: self.n_frames].round(6)  # another walk needs other images
        poses = hashlib.sha256(walk_W.tobytes()).hexdigest()
        options = self._options() | {
            "noise": "",
            "cache": "",
            "version": version(),
            "walk": poses,
        }
        options = {
            name: value for name, value in options.items() if name not in (*_IMPERFECT, "rooms")
        }
        key = hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()[:16]
        return cache_folder() / "room" / f"{self.name}-{self.width}x{self.height}-{key}"

    def _path(self, i: int) -> Path:
        return self._folder / f"{i:06d}.npz"

    def _index(self, i: int) -> int:
        if not -len(self) <= i < len(self):
            raise IndexError(f"room: frame {i} of a sequence of {len(self)} frames")
        return int(i) % len(self)

    def _render(self, i: int) -> dict[str, np.ndarray]:
        rgb, depth_m = render_room(
            self.camera,
            self.true_pose(i),
            seed=self.seed,
            moved=self.moved,
            cache=self.cache,
        )
        return {
            "rgb": np.rint(rgb.numpy() * 255).astype(np.uint8),
            "depth": np.rint(depth_m.numpy() / _DEPTH_UNIT_M).astype(np.uint16),
        }


def _have_size(size: tuple[int, int], images: dict[str, np.ndarray]) -> bool:
    """Whether stored images are those of a frame of this height and width."""
    layout = {"rgb": ((*size, 3), np.uint8), "depth": (size, np.uint16)}
    return {k: (v.shape, v.dtype) for k, v in images.items()} == layout


def render_room(
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    seed: int = 0,
    moved: str = "none",
    cache: bool = True,
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Colour and depth of the room from any pose.

    Depth is that of the exact first hit of the ray through the pixel's centre; colour is the mean
    of 2x2 points per pixel. Both are 0 where a ray from outside the room misses it.

    Args:
        camera: Intrinsics.
        T_WC: Camera-to-world pose, OpenCV axes, metres; the world's z points up. [4, 4]
        seed: The room's seed.
        moved: What stands elsewhere (``RoomSequence.moved``).
        cache: Store the lit textures on disk.

    Returns:
        sRGB colour 0..1 [H, W, 3], and z-depth in metres [H, W]; float32.

    Raises:
        ValueError: ``T_WC`` is not a rigid transform.

    Differentiable: no.
    """
    check_pose("T_WC", T_WC)
    scene = load_scene(seed, cache, moved)
    view = raycast.CameraPatches(
        scene.flat,
        scene.curved,
        camera,
        T_WC.detach().cpu().double().numpy(),
    )
    w, patch = raycast.cast(view)
    rgb = shade.colour(scene, view, w, patch)
    depth_m = np.divide(
        1.0,
        w,
        out=np.zeros_like(w),
        where=patch >= 0,
    )
    return torch.from_numpy(rgb), torch.from_numpy(depth_m)


room = RoomSequence
