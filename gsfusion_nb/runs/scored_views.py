"""The views that a run is scored with, and their poses, stored in the run's folder so that it can be scored again."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import SAVED_RIGIDITY_ERROR, check_pose, check_whole
from ..constants import SHOWN_ALPHA
from ..data import SequenceView
from ..evaluation import score_views
from ..foreign import reason_of
from ..optim import exposed, fit_gain
from ..strict_json import read_object
from ..types import Camera, Frame, RenderOutput
from .mapping_run import MappingRun
from .posed_frames import frames_at, poses_in_map

VIEWS = "views.json"


@dataclasses.dataclass(frozen=True, eq=False)
class ScoredViews:
    """Some frames of a sequence and their poses in the map."""

    positions: list[int]
    """Positions of the frames in the sequence."""
    poses: list[Float[Tensor, "4 4"]]
    """Camera-to-world in the map, float32."""

    def frames(self, sequence: SequenceView) -> Iterator[Frame]:
        """The readable frames with their poses in the map; size and depth limits are those of ``sequence``."""
        view = SequenceView(
            source=sequence.source,
            positions=self.positions,
            camera=sequence.camera,
            depth_min_m=sequence.depth_min_m,
            depth_max_m=sequence.depth_max_m,
        )
        yield from frames_at(view, list(self.poses))


def scored_views(run: MappingRun) -> dict[str, ScoredViews]:
    """The held-out and mapped views of a run that are scored, with their current poses in the map.

    Where pictures refined the mapped poses, the held-out views are there a second time, as the group held_out_between,
    each moved as the mapped views before and after it were; their own pictures are not used.
    """
    localiser, mapping = run.mapper.localiser, run.sequence.mapping
    mapped = run.mapped_views(run.mapper.config.data.scored_views)
    refused = set(mapped.positions) - set(localiser.frame_indices)  # read, but not mapped
    mapped = dataclasses.replace(mapped, positions=[p for p in mapped.positions if p not in refused])
    found = {}
    for name, view in (("held_out", run.sequence.held_out), ("mapped", mapped)):
        posed = [
            (position, T_WC.to("cpu", torch.float32))
            for position, T_WC in zip(view.positions, poses_in_map(view, localiser, mapping), strict=True)
            if T_WC is not None
        ]
        found[name] = ScoredViews([position for position, _ in posed], [T_WC for _, T_WC in posed])
    if localiser.is_refined:
        held_out = found["held_out"]
        moved = [localiser.refined(*view) for view in zip(held_out.positions, held_out.poses, strict=True)]
        found["held_out_between"] = ScoredViews(held_out.positions, moved)
    return found


def score_in_map(
    render: Callable[[Camera, Tensor], RenderOutput],
    views: dict[str, ScoredViews],
    sequence: SequenceView,
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
        align: If given, the held-out views are scored once more, as the group held_out_aligned, each at the pose that
            it returns, at which the map fits the picture best (``StoredMap.aligned_pose``), and as the group
            held_out_fitted with brightness and white balance fitted, too (``fit_gain``).
    """
    metrics: dict[str, Any] = {}
    groups = {name: (render, group) for name, group in views.items()}
    if align is not None:
        aligned, gains = _aligned(views["held_out"].frames(sequence), render, align)
        groups["held_out_aligned"] = render, aligned
        groups["held_out_fitted"] = _with_exposures(render, gains), aligned
    for name, (draw, group) in groups.items():
        scores = score_views(draw, group.frames(sequence), with_lpips=with_lpips)
        metrics |= scores.as_metrics(name + suffix)
        metrics[f"n_views_{name}{suffix}"] = len(scores)
    return metrics


def _aligned(
    frames: Iterator[Frame], draw: Callable[[Camera, Tensor], RenderOutput], align: Callable[[Frame], Tensor]
) -> tuple[ScoredViews, list[Tensor]]:
    """The views at the poses that fit their pictures to the map best, and their exposures there."""
    views, gains = ScoredViews([], []), []
    for frame in frames:
        T_WC = align(frame)
        shown = draw(frame.camera, T_WC)
        views.positions.append(frame.index)
        views.poses.append(T_WC.to(frame.T_WC))
        gains.append(fit_gain(shown.rgb, frame.rgb.to(shown.rgb.device), shown.alpha >= SHOWN_ALPHA))
    return views, gains


def _with_exposures(
    draw: Callable[[Camera, Tensor], RenderOutput], gains: list[Tensor]
) -> Callable[[Camera, Tensor], RenderOutput]:
    """A renderer that shows one view after the other, each with its exposure."""
    remaining = iter(gains)

    def shown(camera: Camera, T_WC: Tensor) -> RenderOutput:
        output = draw(camera, T_WC)
        return dataclasses.replace(output, rgb=exposed(output.rgb, next(remaining).to(output.rgb)))

    return shown


def views_as_json(views: dict[str, ScoredViews]) -> dict[str, Any]:
    """The views as plain values for JSON; float32 poses are read back from them bit for bit."""
    return {
        name: [
            {"frame": position, "T_WC": T_WC.flatten().tolist()}
            for position, T_WC in zip(group.positions, group.poses, strict=True)
        ]
        for name, group in views.items()
    }


def read_views(folder: Path) -> dict[str, ScoredViews]:
    """Read the views from ``views.json`` in a run's folder.

    Raises:
        FileNotFoundError: The run is from a version that did not write the file. ValueError: The file is damaged.
    """
    path = folder / VIEWS
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist, so the views to score and their poses are not known; the run is from an older "
            "version: map the data again"
        )
    try:
        document = read_object(path, "the views that a run is scored by")
        return {name: _read_group(group) for name, group in document.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as e:
        raise ValueError(f"{path} is damaged: {reason_of(e)}") from None


def _read_group(group: list[dict[str, Any]]) -> ScoredViews:
    views = ScoredViews([], [])
    for view in group:
        T_WC = torch.tensor(view["T_WC"], dtype=torch.float32).reshape(4, 4)
        check_whole("frame", view["frame"], 0)
        check_pose(f"T_WC of frame {view['frame']}", T_WC, SAVED_RIGIDITY_ERROR)
        views.positions.append(view["frame"])
        views.poses.append(T_WC)
    return views
