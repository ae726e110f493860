"""Why a GSFusion map has hardly any Gaussians, or no keyframe, in words."""

import math

from ..config import GSFusionConfig
from ..seeding.quadtree import QUADTREE_NORMALISER
from ..types import Camera

_RULE = "gsfusion"
_PUBLISHED_AT_PX = 1200 * 680
"""Size of the images of Replica, for which the threshold was published."""

LOOKED_AT = 10
"""Frames after which a map is looked at while it is made."""


def why_few(
    config: GSFusionConfig, camera: Camera | None, n_frames: int, n_gaussians: int, n_keyframes: int
) -> str:
    """A sentence if the frames so far gave fewer Gaussians than one keyframe has, or no keyframe;
    else empty. A ``keyframe_min_seeds`` of at least the number of pixels is a wish for none, and
    gives no sentence.

    Args:
        config: Settings of the map.
        camera: Of its frames, if it is known.
        n_frames, n_gaussians, n_keyframes: So far.
    """
    least = config.keyframe_min_seeds
    is_wish = camera is not None and least >= camera.width * camera.height
    if is_wish or (n_keyframes and n_gaussians > least):
        return ""
    said = [f"there are only {n_gaussians:,} Gaussians after {n_frames} frames"]
    if not n_keyframes:
        said.append(
            f"no frame added more than {least} (keyframe_min_seeds), so none is a keyframe, and "
            "the passes after the scan change nothing"
        )
    if (
        config.seeding.rule == _RULE
        and config.seeding.quadtree_contrast == "released"
        and camera is not None
    ):
        said.append(_of_quadtree(config.seeding.quadtree_threshold, camera))
    else:
        said.append(
            f"let the seeding rule {config.seeding.rule!r} propose more, or set a smaller "
            "keyframe_min_seeds"
        )
    return "; ".join(said)


def _of_quadtree(threshold: float, camera: Camera) -> str:
    """At how small a contrast the quadtree cuts, and which settings cut at a smaller one."""
    n_px = camera.width * camera.height
    contrast = math.sqrt(threshold * QUADTREE_NORMALISER / n_px)
    return (
        f"at {camera.width} x {camera.height} pixels the quadtree cuts only cells whose colours "
        f"vary by {contrast:.0f} of 255 or more: for small images use --seeding.quadtree-contrast "
        f"std, or --seeding.quadtree-threshold {threshold * n_px / _PUBLISHED_AT_PX:.2g}, which "
        "cuts as it does at 1200 x 680"
    )
