"""The views that a run is scored with and their scores, stored so that it can be scored
again."""

import bisect
import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import SAVED_RIGIDITY_ERROR, check_pose, check_saved, check_whole
from ..data import FrameSubset
from ..errors import ArgumentError, SequenceError, reason_of
from ..evaluation import ImageScores, score_view
from ..files import read_object
from ..mapping.keyframe_fits import exposure_between
from ..mapping.map_files import Draw
from ..mapping.tracking_surface import localised_pose
from ..optim import apply_exposure, fit_exposure
from ..render.constants import SHOWN_ALPHA
from ..types import Frame, RenderOutput
from .mapped_views import evenly
from .mapping_run import MappingRun
from .poses_in_map import frames_at, poses_in_map

VIEWS = "views.json"


@dataclasses.dataclass(frozen=True, eq=False)
class ScoredViews:
    """Some frames of a sequence, their poses in the map, and with which exposure the map is shown
    there."""

    positions: list[int]
    """Positions of the frames in the sequence."""
    poses: list[Float[Tensor, "4 4"]]
    """Camera-to-world in the map, float32."""
    exposures: dict[int, Float[Tensor, " 3"]] = dataclasses.field(default_factory=dict)
    """Position -> factor of each colour between the map's picture and this view's; 1 for the
    others."""

    def spread(self, limit: int) -> "ScoredViews":
        """At most ``limit`` of the views, evenly spread."""
        picks = evenly(len(self.positions), limit)
        return ScoredViews(
            [self.positions[i] for i in picks],
            [self.poses[i] for i in picks],
            self.exposures,
        )

    def frames(self, sequence: FrameSubset) -> Iterator[Frame]:
        """The readable frames with their poses in the map; size and depth limits are those of
        ``sequence``."""
        view = FrameSubset(
            source=sequence.source,
            positions=self.positions,
            camera=sequence.camera,
            depth_min_m=sequence.depth_min_m,
            depth_max_m=sequence.depth_max_m,
            kept=sequence.kept,
        )
        yield from frames_at(view, list(self.poses))

    def scores(self, draw: Draw, sequence: FrameSubset, *, with_lpips: bool = False) -> ImageScores:
        """The scores of the readable frames; what ``draw`` renders is shown with the exposure of
        each view."""
        return ImageScores(
            rows=tuple(
                score_view(self._shown(draw, frame), frame, with_lpips=with_lpips)
                for frame in self.frames(sequence)
            )
        )

    def _shown(self, draw: Draw, frame: Frame) -> RenderOutput:
        with torch.no_grad():
            output = draw(frame.camera, frame.T_WC)
        exposure = self.exposures.get(frame.index)
        return (
            output
            if exposure is None
            else dataclasses.replace(
                output, rgb=apply_exposure(output.rgb, exposure.to(output.rgb))
            )
        )


def scored_views(run: MappingRun) -> dict[str, ScoredViews]:
    """The held-out and mapped views of a run that are scored, with their current poses in the map.

    Held-out views of tracked recordings without poses are aligned with the map by their depth and
    brightness; those that fit nowhere are left out, and the run says so.

    Where pictures refined the mapped poses or exposures, the held-out views are there a second
    time, as the group held_out_between, each moved as the mapped views before and after it were,
    and with an exposure between theirs; their own pictures are not used.
    """
    localiser = run.mapper.localiser
    trajectory = run.mapper.trajectory
    mapping = run.sequence.mapping
    map_views = run.views.sample(run.mapper.config.data.scored_views)
    not_mapped = set(map_views.positions) - set(trajectory.frame_indices)  # read, but not mapped
    map_views = dataclasses.replace(
        map_views, positions=[p for p in map_views.positions if p not in not_mapped]
    )
    groups = {}
    for name, view in (("held_out", run.sequence.held_out), ("mapped", map_views)):
        poses = poses_in_map(view, localiser, mapping)
        if name == "held_out":
            poses = _localised(run, view, poses)
        with_pose = [
            (position, T_WC.to("cpu", torch.float32))
            for position, T_WC in zip(view.positions, poses, strict=True)
            if T_WC is not None
        ]
        groups[name] = ScoredViews(
            [position for position, _ in with_pose], [T_WC for _, T_WC in with_pose]
        )
    held_out = groups["held_out"]
    exposures = _exposures_between(run, held_out.positions)
    if trajectory.is_refined or exposures:
        refined_poses = [
            trajectory.refined_pose(*view)
            for view in zip(held_out.positions, held_out.poses, strict=True)
        ]
        groups["held_out_between"] = ScoredViews(held_out.positions, refined_poses, exposures)
    return groups


def _localised(
    run: MappingRun, view: FrameSubset, poses: list[Float[Tensor, "4 4"] | None]
) -> list[Float[Tensor, "4 4"] | None]:
    """The poses of held-out views, and where the map was tracked of those without one: aligned with
    the map as it is.

    They are found once for each state of the map.
    """
    mapper = run.mapper
    missing = [i for i, T_WC in enumerate(poses) if T_WC is None]
    if not missing or not mapper.localiser.is_tracking or not mapper.trajectory.poses:
        return poses
    state = (
        run.next_position,
        mapper.n_frames,
        mapper.passes.done,
        len(mapper.passes.queue),
        tuple(view.positions),
    )
    if run.localised is None or run.localised[0] != state:
        pose_of: dict[int, Tensor] = {}
        for frame in frames_at(view, [torch.eye(4) if T_WC is None else None for T_WC in poses]):
            with contextlib.suppress(SequenceError):
                T_WC = localised_pose(mapper, frame)
                if T_WC is not None:
                    pose_of[frame.index] = T_WC
        run.localised = state, pose_of
        missing_frames = [view.positions[i] for i in missing if view.positions[i] not in pose_of]
        if missing_frames:
            run.warnings.warn_once(
                f"{len(missing_frames)} of {len(missing)} held-out frames could not be found in "
                f"the map and are not scored, the first is frame {missing_frames[0]}"
            )
    poses_found = run.localised[1]
    return [
        poses_found.get(index) if T_WC is None else T_WC
        for index, T_WC in zip(view.positions, poses, strict=True)
    ]


def _exposures_between(
    run: MappingRun,
    positions: list[int],
) -> dict[int, Float[Tensor, " 3"]]:
    """The exposure of each held-out view by those of the mapped views before and after it; empty
    without fitted ones.

    Of a mapped view that is no keyframe it is fitted here, from its picture.
    """
    mapper = run.mapper
    mapping = run.sequence.mapping
    exposure_of = {k.index: k.exposure for k in mapper.keyframes if k.exposure is not None}
    if not exposure_of:
        return {}
    poses = dict(zip(mapper.trajectory.frame_indices, mapper.trajectory.poses, strict=True))
    indices = sorted(poses)
    places = [bisect.bisect(indices, p) for p in positions]
    neighbours = {i for at in places for i in indices[max(at - 1, 0) : at + 1]} - exposure_of.keys()
    view_positions = [i for i in mapping.positions if i in neighbours]
    view = dataclasses.replace(mapping, positions=view_positions)
    for frame in frames_at(view, [poses[i] for i in view_positions]):
        output = mapper.render(frame.camera, frame.T_WC)
        exposure_of[frame.index] = fit_exposure(
            output.rgb, frame.rgb.to(output.rgb), output.alpha >= SHOWN_ALPHA
        )
    return {p: exposure_between(exposure_of, p) for p in positions}


def score_in_map(
    render: Draw,
    views: dict[str, ScoredViews],
    sequence: FrameSubset,
    suffix: str = "",
    *,
    with_lpips: bool = False,
    align: Callable[[Frame], Tensor] | None = None,
) -> dict[str, Any]:
    """PSNR, SSIM, LPIPS and depth error of each group of views, under the names of metrics.json.

    Args:
        render: Renders the map for a camera and its camera-to-world pose.
        views: Name of the group -> its views.
        sequence: The sequence that holds their images.
        suffix: Appended to the name of the group.
        with_lpips: Also compute LPIPS.
        align: If given, the held-out views are scored once more, as the group held_out_aligned,
            each at the pose that it returns, at which the map fits the picture best
            (``MapFiles.aligned_pose``), and as the group held_out_fitted with brightness and white
            balance fitted, too (``fit_exposure``).
    """
    metrics: dict[str, Any] = {}
    groups = dict(views)
    if align is not None:
        fits = _fitted(views["held_out"].frames(sequence), render, align)
        groups["held_out_aligned"] = dataclasses.replace(fits, exposures={})
        groups["held_out_fitted"] = fits
    for name, group in groups.items():
        scores = group.scores(render, sequence, with_lpips=with_lpips)
        metrics |= scores.as_metrics(name + suffix)
        metrics[f"n_views_{name}{suffix}"] = len(scores)
    return metrics


def _fitted(
    frames: Iterator[Frame],
    draw: Draw,
    align: Callable[[Frame], Tensor],
) -> ScoredViews:
    """The views at the poses that fit their pictures to the map best, and their exposures there."""
    views = ScoredViews([], [])
    for frame in frames:
        T_WC = align(frame)
        output = draw(frame.camera, T_WC)
        views.positions.append(frame.index)
        views.poses.append(T_WC.to(frame.T_WC))
        views.exposures[frame.index] = fit_exposure(
            output.rgb, frame.rgb.to(output.rgb.device), output.alpha >= SHOWN_ALPHA
        )
    return views


def views_as_json(views: dict[str, ScoredViews]) -> dict[str, Any]:
    """The views as plain values for JSON; float32 poses and exposures are read back from them bit
    for bit."""
    return {
        name: [
            {"frame": position, "T_WC": T_WC.flatten().tolist()}
            | ({"gain": group.exposures[position].tolist()} if position in group.exposures else {})
            for position, T_WC in zip(group.positions, group.poses, strict=True)
        ]
        for name, group in views.items()
    }


def read_views(folder: Path) -> dict[str, ScoredViews]:
    """Read the views from ``views.json`` in a run's folder.

    Raises:
        FileNotFoundError: The run is from a version that did not write the file. ValueError: The
            file is damaged.
    """
    path = folder / VIEWS
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist, so the views to score and their poses are not known; the run "
            "is from an older version: map the data again"
        )
    try:
        document = read_object(path, "the views that a run is scored by")
        return {name: _read_group(group) for name, group in document.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as e:
        raise ArgumentError(f"{path} is damaged: {reason_of(e)}") from None


def _read_group(group: list[dict[str, Any]]) -> ScoredViews:
    views = ScoredViews([], [])
    for view in group:
        T_WC = torch.tensor(view["T_WC"], dtype=torch.float32).reshape(4, 4)
        check_whole("frame", view["frame"], 0)
        check_pose(f"T_WC of frame {view['frame']}", T_WC, SAVED_RIGIDITY_ERROR)
        views.positions.append(view["frame"])
        views.poses.append(T_WC)
        if "gain" in view:
            exposure = torch.tensor(view["gain"], dtype=torch.float32)
            check_saved(f"gain of frame {view['frame']}", exposure, (3,))
            views.exposures[view["frame"]] = exposure
    return views
