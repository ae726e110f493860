"""The numbers of the panels: frames of the built-in room, and maps that a mapper makes of it."""

import base64
import dataclasses
import io
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.types import Frame, GaussianParams
from gsfusion_nb.viewer.palettes import palette
from gsfusion_nb.viewer.viewpoint import places_of

WALK = 60
"""Frames of the room's walk."""


def panel_data(name: str) -> dict[str, Any]:
    """What a panel knows besides its equations."""
    return _DATA[name]() if name in _DATA else {}


def _pixel() -> dict[str, Any]:
    room = _room(160)
    frames = [room[0], room[2]]
    sharp = _room(640)
    return {
        "camera": dataclasses.asdict(room.camera),
        "poses": [frame.T_WC[:3].tolist() for frame in frames],
        "photos": [_photo(sharp[i].rgb_u8) for i in (0, 2)],
        "depth": _packed_depth(frames),
    }


def _fusion() -> dict[str, Any]:
    """The first frame's exact depth, then those of a Kinect."""
    room = _room(80, 240)
    noisy = _room(80, 240, noise="kinect")
    measurements = [noisy[i] for i in range(16)]
    return {
        "camera": dataclasses.asdict(room.camera),
        "poses": [frame.T_WC[:3].tolist() for frame in measurements],
        "photos": [_photo(_room(640, 240)[0].rgb_u8)],
        "depth": _packed_depth([room[0], *measurements]),
    }


def _quadtree() -> dict[str, Any]:
    frame = _room(320)[0]
    return {
        "camera": dataclasses.asdict(frame.camera),
        "photos": [_photo(_room(640)[0].rgb_u8)],
        "rgb": _packed(frame.rgb_u8.numpy()),
        "colours": [f"rgb({r},{g},{b})" for r, g, b in palette("viridis")[::17]],
    }


def _seeds() -> dict[str, Any]:
    frame = _room(160)[6]
    return {
        "camera": dataclasses.asdict(frame.camera),
        "photo": _photo(_room(640)[6].rgb_u8),
        "rgb": _packed(frame.rgb_u8.numpy()),
        "depth": _packed_depth([frame]),
    }


def _paint() -> dict[str, Any]:
    return {"photo": _photo(_room(192)[6].rgb_u8)}


def _stack() -> dict[str, Any]:
    """A map of the first frames, drawn from one of them."""
    run = _mapping_run(160, n_frames=8, threshold=0.02, passes=12)
    for _ in (*run.online(), *run.optimise()):
        pass
    frame = run.sequence.mapping[6]
    params = run.mapper.gaussians.params
    return {
        "camera": dataclasses.asdict(frame.camera),
        "pose": frame.T_WC[:3].tolist(),
        "map": packed_maps([params]),
    }


SNAPSHOT_EVERY = 5
"""Frames between two stored maps of the room."""
ROOM_FRAMES = 48
STORED_PASSES = (1, 3, 8)
"""Passes over the keyframes after which the map of the room is stored."""


def _room_map() -> dict[str, Any]:
    """The map of the room after every fifth frame and after passes over the keyframes, without
    revisits; and how well each map shows each frame."""
    run = _mapping_run(
        128, n_frames=ROOM_FRAMES, threshold=0.08, passes=STORED_PASSES[-1], steps=(10, 0)
    )
    mapper = run.mapper
    frames = list(run.sequence.mapping)
    maps: list[GaussianParams] = []
    moments: list[dict[str, int]] = []
    scores: list[list[float]] = []
    own: list[float] = []

    def keep(n_frames: int, n_passes: int) -> None:
        maps.append(_copy(mapper.gaussians.params))
        moments.append({"frames": n_frames, "pass": n_passes})
        scores.append([round(score, 2) for score in _scores(mapper, frames)])

    for k, frame in enumerate(frames, 1):
        mapper.step(frame)
        own.append(round(_scores(mapper, [frame])[0], 2))
        if k == 1 or k % SNAPSHOT_EVERY == 0 or k == len(frames):
            keep(k, 0)
    for n_steps, _ in enumerate(run.optimise(), 1):
        n_passes, unfinished = divmod(n_steps, len(mapper.keyframes))
        if not unfinished and n_passes in STORED_PASSES:
            keep(len(frames), n_passes)
    revisiting = _mapping_run(128, n_frames=ROOM_FRAMES, threshold=0.08, passes=0, steps=(5, 5))
    for frame in frames:
        revisiting.mapper.step(frame)
    camera = frames[0].camera
    above = places_of(mapper.gaussians.params, camera, frames[0].T_WC, _up(frames))["above"]
    return {
        "camera": dataclasses.asdict(camera),
        "frames": [frame.index for frame in frames],
        "poses": [_rounded(frame.T_WC[:3]) for frame in frames],
        "above": {"pose": _rounded(above.T_WC[:3]), "cut": above.cut_m},
        "photos": _photo(_sheet(frames), quality=45),
        "moments": moments,
        "psnr": scores,
        "own": own,
        "revisited": [round(score, 2) for score in _scores(revisiting.mapper, frames)],
        "map": packed_maps(maps),
    }


def _mapping_run(
    width: int,
    *,
    n_frames: int,
    threshold: float,
    passes: int,
    steps: tuple[int, int] = (5, 2),
) -> MappingRun:
    """A small map of the room: few Gaussians of one colour each.

    Args:
        width: Of the pictures, pixels.
        n_frames: Of the walk.
        threshold: Of the quadtree.
        passes: Over the keyframes, after the walk.
        steps: On each frame, and on earlier keyframes after it.
    """
    own, revisits = steps
    config = gsfusion(
        "room",
        sh_degree=0,
        data__width=width,
        data__height=width * 3 // 4,
        data__stop=n_frames,
        tsdf__voxel_size_m=0.04,
        seeding__quadtree_threshold=threshold,
        seeding__quadtree_min_cell_px=2,
        seeding__quadtree_largest_m=0.25,
        seeding__thickness=0.3,
        seeding__opacity=0.8,
        optim__keyframe_iterations=own,
        optim__frame_iterations=own,
        optim__random_keyframe_iterations=revisits,
        optim__global_iterations=passes,
        optim__lr_log_scale=1e-2,
        optim__lr_quat=1e-2,
    )
    sequence = open_sequence("room", data=config.data, n_frames=WALK)
    return MappingRun(sequence, GSFusion(config))


def _scores(mapper: GSFusion, frames: Sequence[Frame]) -> list[float]:
    """PSNR of the map on each frame, dB."""
    scores = []
    for frame in frames:
        rgb = mapper.render(frame.camera, frame.T_WC).rgb.clamp(0, 1)
        scores.append(-10 * float((rgb - frame.rgb).square().mean().log10()))
    return scores


def _copy(params: GaussianParams) -> GaussianParams:
    return GaussianParams(**{name: x.detach().clone() for name, x in vars(params).items()})


def _up(frames: Sequence[Frame]) -> Tensor:
    """The world's up direction: cameras stand upright on average."""
    return -torch.stack([frame.T_WC[:3, 1] for frame in frames]).mean(0)


def _rounded(matrix: Tensor) -> list[list[float]]:
    return [[round(x, 5) for x in row] for row in matrix.tolist()]


def _sheet(frames: Sequence[Frame], across: int = 8) -> Tensor:
    """The photographs side by side, row after row. [H, W, 3]"""
    blank = torch.zeros_like(frames[0].rgb_u8)
    pictures = [frame.rgb_u8 for frame in frames]
    pictures += [blank] * (-len(pictures) % across)
    rows = [torch.cat(pictures[k : k + across], dim=1) for k in range(0, len(pictures), across)]
    return torch.cat(rows, dim=0)


_LEVELS = {np.uint16: 8192, np.uint8: 128}
_NARROW = ("log_scale", "quat", "opacity_logit", "sh")


def packed_maps(maps: Sequence[GaussianParams]) -> dict[str, Any]:
    """Maps as levels between the extremes of each parameter, 8192 for a place and 128 for the rest,
    each map as what it adds to the one before.

    Args:
        maps: Each has at least the rows of the one before, in the same order; colours of degree 0.

    Returns:
        What ``maps.js`` reads: counts, ranges, and two compressed streams.
    """
    ranges = {
        name: [
            min(float(_numbers(params, name).min()) for params in maps),
            max(float(_numbers(params, name).max()) for params in maps),
        ]
        for name in ("xyz_W", *_NARROW)
    }
    wide = _deltas(maps, ("xyz_W",), ranges, np.uint16)
    narrow = _deltas(maps, _NARROW, ranges, np.uint8)
    return {
        "counts": [len(params) for params in maps],
        "ranges": ranges,
        "wide": _packed(wide),
        "narrow": _packed(narrow),
    }


def _numbers(params: GaussianParams, name: str) -> np.ndarray:
    """A column of a map, unit quaternions, sizes and opacities where a picture can tell them
    apart. [N, W]"""
    values = getattr(params, name).detach().double().reshape(len(params), -1)
    if name == "quat":
        values = torch.nn.functional.normalize(values, dim=1)
    limits = {"log_scale": (-7.0, 1.0), "opacity_logit": (-6.0, 8.0), "sh": (-1.8, 1.8)}
    low, high = limits.get(name, (None, None))
    return (values if low is None else values.clamp(low, high)).numpy()


def _deltas(
    maps: Sequence[GaussianParams],
    names: Sequence[str],
    ranges: Mapping[str, Sequence[float]],
    kind: type[np.unsignedinteger],
) -> np.ndarray:
    """Differences of the levels, map after map, column after column; they wrap around."""
    parts = []
    before: dict[str, np.ndarray] = {}
    top = _LEVELS[kind] - 1
    for params in maps:
        for name in names:
            low, high = ranges[name]
            levels = np.rint((_numbers(params, name) - low) / (high - low or 1.0) * top)
            levels = levels.astype(kind)
            old = before.get(name, levels[:0])
            delta = levels - np.pad(old, ((0, len(levels) - len(old)), (0, 0)))
            parts.append(delta.T.ravel())
            before[name] = levels
    return np.concatenate(parts)


def _room(width: int, n_frames: int = WALK, **options: Any) -> RoomSequence:
    return RoomSequence(n_frames=n_frames, width=width, height=width * 3 // 4, **options)


def _photo(rgb_u8: Tensor, quality: int = 82) -> str:
    """A picture as a WebP file, in base 64."""
    file = io.BytesIO()
    Image.fromarray(rgb_u8.numpy()).save(file, "WEBP", quality=quality, method=6)
    return base64.b64encode(file.getvalue()).decode("ascii")


def _packed_depth(frames: Sequence[Frame]) -> str:
    """Depth in 0.1 mm."""
    return _packed(np.stack([(f.depth_m * 1e4).round().numpy().astype(np.uint16) for f in frames]))


def _packed(numbers: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(numbers.tobytes(), 9)).decode("ascii")


_DATA: dict[str, Callable[[], dict[str, Any]]] = {
    "pixel": _pixel,
    "fusion": _fusion,
    "quadtree": _quadtree,
    "seeds": _seeds,
    "paint": _paint,
    "stack": _stack,
    "room": _room_map,
}
