"""The unit of depth by the camera's motion: the one with which depth images predict each other
under the given poses.

A camera that moves by 10 cm sees a wall at 1 m grow, and one at 2 m half as much: of all units only
the right one makes the points of one depth image fall on the surface in another.
"""

import contextlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...data.adjust.depth_agreement import depth_consistency, relative_poses, sparse_points, thinned
from ...data.lens import same_proportions
from ...errors import BadFrameError
from ...geometry import pixel_grid
from ...types import Camera
from ..checkup.agreement import CalibrationCorrection, FitData, reproject
from .depth_unit import KNOWN
from .frame_poses import FramePoses
from .intrinsics import intrinsics_of_frame, read_intrinsics
from .recording import ConvertOptions, DepthUnit, OptionNeeded, RecordedFrame, Recording

_ANCHORS = 10
_GAPS = (1, 4, 12, 30)
"""Frames between the two of a pair."""
_PAIRS = 20
"""Pairs that tell the unit best are compared closely."""
_WIDTH = 160
"""Of the depth images that are compared."""
_POINTS = 200
"""Of a depth image that are moved."""
_SCALES = 1000.0 * np.exp(np.linspace(np.log(0.0005), np.log(40.0), 115))
"""Units a metre to try, 0.5 to 40,000 in steps of 10 %."""
_TOLERANCE = 0.06
"""A point agrees if its depth differs by less than this share; of a precise sensor less."""
_AROUND = np.linspace(-0.5, 0.5, 41)
"""Units around the best that are tried closely, as logarithms of factors on it."""
_FEWEST_PAIRS = 3
_TELLS = 0.1
"""A pair tells the unit if its score, 0 to 1, differs by more between the units."""
_LEAST_SCORE = 0.2
_CLEAR = 0.85
"""Of the best score all units that differ by more than ``_NEAR`` stay below this share, and in the
coarse comparison those that are not tried closely below ``_CLEAR_FAR``."""
_CLEAR_FAR = 0.95
_NEAR = 1.2
_SNAPS = 1.1
"""A unit that programs write is taken if the best one is nearer to it than this factor."""
_FILMED_M = (0.1, 60.0)
"""Medians of depth that people film."""


@dataclass(frozen=True, eq=False)
class PosedDepth:
    """A depth image as stored, its camera and where it was."""

    stored: Float[Tensor, "H W"]
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    """Metres."""


def measured_unit(recording: Recording, options: ConvertOptions) -> DepthUnit | None:
    """The unit of depth that the poses tell; None where there are none, or where they do not tell
    it.

    Args:
        recording: Depth is read in its ``depth_scale``.
        options: How it is read.

    Raises:
        OptionNeeded: the poses or the camera are missing, or the motion tells a unit that no
            program writes.
    """
    poses = FramePoses(recording, options)
    if poses.none:
        return None
    anchors = _anchors(recording.n_frames)
    places = {a + gap for a in anchors for gap in (0, *_GAPS)}
    by_place: dict[int, PosedDepth] = {}
    for place, frame in enumerate(recording.frames()):
        if place in places and (posed_depth := _posed(poses, place, frame, recording, options)):
            by_place[place] = posed_depth
    pairs = [
        (by_place[a], by_place[a + gap])
        for a in anchors
        for gap in _GAPS
        if {a, a + gap} <= by_place.keys()
    ]
    pairs = _of_one_size(pairs)
    best = units_per_metre(pairs)
    if best is None:
        return None
    middle_m = float(np.median([float(p.stored[p.stored > 0].median()) for p, _ in pairs])) / best
    if not _FILMED_M[0] <= middle_m <= _FILMED_M[1]:
        return None
    usual_scale = min(KNOWN, key=lambda scale: abs(np.log(scale / best)))
    if max(usual_scale / best, best / usual_scale) > _SNAPS:
        raise OptionNeeded(
            f"{recording.name}: by the camera's motion one metre is {best:.4g} units of depth, "
            "which no program writes; if the poses are right: --depth-scale with that number; "
            "else the unit, and gsfusion-nb check",
            option="depth_scale",
            question=f"By the camera's motion one metre is {best:.4g} units of depth. Which stored "
            "depth is one metre?",
        )
    sentence = (
        f"depth was taken as {usual_scale:g} units a metre, measured by the camera's motion on "
        f"{len(pairs)} pairs of frames ({best:.4g}; --depth-scale)"
    )
    return DepthUnit(usual_scale, sentence)


def _of_one_size(
    pairs: Sequence[tuple[PosedDepth, PosedDepth]],
) -> list[tuple[PosedDepth, PosedDepth]]:
    """Those pairs whose images have the size that most have."""
    sizes = Counter(image.stored.shape for pair in pairs for image in pair)
    usual = [size for size, _ in sizes.most_common(1)]
    return [pair for pair in pairs if all(image.stored.shape in usual for image in pair)]


def units_per_metre(pairs: Sequence[tuple[PosedDepth, PosedDepth]]) -> float | None:
    """Stored depth of one metre under which the first image of each pair predicts the second; None:
    unclear."""
    if not pairs:
        return None
    curves = torch.stack([_coarse_scores(first, second) for first, second in pairs])
    contrast = curves.amax(1) - curves.amin(1)
    best_pairs = contrast.argsort(descending=True)[:_PAIRS]
    best_pairs = best_pairs[contrast[best_pairs] > _TELLS]
    if len(best_pairs) < min(_FEWEST_PAIRS, len(pairs)):
        return None
    coarse = curves[best_pairs].mean(0).numpy()
    best = float(_SCALES[int(coarse.argmax())])
    beyond = np.abs(np.log(_SCALES / best)) > _AROUND[-1]
    if coarse[beyond].max() > _CLEAR_FAR * coarse.max():
        return None
    close = _fit_data([pairs[i] for i in best_pairs.tolist()])
    _, residual, is_measured = reproject(close, _correction(best))
    precise = min(
        max(3 * float(residual[is_measured].abs().median()), 0.002),
        _TOLERANCE,
    )
    scores = np.array(
        [float(_scores(close, best * math.exp(step), precise).mean()) for step in _AROUND]
    )
    top = int(scores.argmax())
    is_far = np.abs(_AROUND - _AROUND[top]) > math.log(_NEAR)
    if scores[top] < _LEAST_SCORE or scores[is_far].max() > _CLEAR * scores[top]:
        return None
    return best * math.exp(_AROUND[top])


def _coarse_scores(first: PosedDepth, second: PosedDepth) -> Float[Tensor, " S"]:
    """How well an image predicts another in each of ``_SCALES``, 0 to 1, by the nearest pixels.
    [S]"""
    step = max(1, round(math.sqrt(first.stored.numel() / _POINTS)))
    points = sparse_points(first.camera, first.stored, step)
    if not len(points):
        return torch.zeros(len(_SCALES))
    T_ba = relative_poses(first.T_WC, second.T_WC).expand(len(_SCALES), 4, 4).clone()
    T_ba[:, :3, 3] *= torch.from_numpy(_SCALES)[:, None]
    return depth_consistency(points, second.stored, second.camera, T_ba).score


def _fit_data(pairs: Sequence[tuple[PosedDepth, PosedDepth]]) -> FitData:
    """Points of the first images and the second images of the pairs, with depth as stored."""
    frames = list({id(frame): frame for pair in pairs for frame in pair}.values())
    row = {id(frame): i for i, frame in enumerate(frames)}
    full = frames[0].camera
    step = max(1, round(full.width / _WIDTH))
    small = [thinned(frame.camera, frame.stored, step) for frame in frames]
    camera = small[0][0]
    depth = torch.stack([image for _, image in small])
    spacing = max(1, round(math.sqrt(camera.width * camera.height / _POINTS)))
    uv = pixel_grid(camera)[spacing // 2 :: spacing, spacing // 2 :: spacing].reshape(-1, 2)
    u, v = uv.long().unbind(-1)
    first = [row[id(a)] for a, _ in pairs]
    second = [row[id(b)] for _, b in pairs]
    T_WC = torch.stack([frame.T_WC for frame in frames])
    return FitData(
        uv_a=uv.expand(len(pairs), -1, 2),
        depth_a=depth[first][:, v, u],
        depth_b=depth[second],
        camera=camera,
        thinning=full.width / camera.width,
        rows=(first, second),
        path=lambda shift: T_WC,
    )


def _correction(units_per_m: float) -> CalibrationCorrection:
    return CalibrationCorrection(log_scale=-math.log(units_per_m))


def _scores(data: FitData, units_per_m: float, tolerance: float) -> Float[Tensor, " P"]:
    """How well the first image of each pair predicts the second in a unit: 0, nowhere, to 1,
    everywhere exactly."""
    _, residual, is_measured = reproject(data, _correction(units_per_m))
    each = (1 - residual.abs() / tolerance).clamp_min(0) * is_measured
    return each.sum(1) / (data.depth_a > 0).sum(1).clamp_min(1)


def _anchors(n_frames: int) -> list[int]:
    last = max(0, n_frames - 1 - min(_GAPS[-2], n_frames // 2))
    return sorted({int(place) for place in np.linspace(0, last, _ANCHORS)})


def _posed(
    poses: FramePoses,
    place: int,
    frame: RecordedFrame,
    recording: Recording,
    options: ConvertOptions,
) -> PosedDepth | None:
    """A frame with its pose and its depth as stored; None where one of them is missing or
    damaged."""
    with contextlib.suppress(BadFrameError):
        T_WC, _ = poses.of(place, poses.timed(frame))
        if T_WC is None:
            return None
        images = frame.load()
        height, width = images.depth_m.shape
        depth_values = torch.from_numpy(images.depth_m * np.float32(recording.depth_scale))
        colour_size = (images.rgb.shape[1], images.rgb.shape[0])
        camera = _camera(frame, colour_size, (width, height), recording, options)
        return None if camera is None else PosedDepth(depth_values, camera, T_WC)
    return None


def _camera(
    frame: RecordedFrame,
    colour_size: tuple[int, int],
    size: tuple[int, int],
    recording: Recording,
    options: ConvertOptions,
) -> Camera | None:
    """The pinhole of the depth image, whose lens may be left out for this; None if depth shows
    another view."""
    if options.depth_intrinsics not in ("", "colour"):
        model = read_intrinsics(options.depth_intrinsics, size, centre=options.pixel_centre)
    elif frame.depth_model is not None and not options.depth_intrinsics:
        model = frame.depth_model
    else:
        model = intrinsics_of_frame(frame, colour_size, recording.name, options)
    camera_size = (model.camera.width, model.camera.height)
    return model.camera.resized(*size) if same_proportions(size, camera_size) else None
