"""Questions about the frame: measured pixels, normals, edges, leaves of the quadtree, and round
seeds on the measured surface."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from ..errors import ArgumentError
from ..geometry import backproject, depth_to_normals, pixel_grid, se3
from ..types import Seeds
from .depth_from_sides import depth_from_sides
from .discs import as_discs, over_cells
from .image_features import canny
from .inputs import SeedInputs, cached_result
from .quadtree import Cells, cell_gaussians, cut_to_size, quadtree


def has_depth(inputs: SeedInputs) -> Bool[Tensor, "H W"]:
    """Pixels whose depth can be used."""
    return _is_measured(inputs, inputs.frame.depth_m)


def pixels(inputs: SeedInputs, where: Bool[Tensor, "H W"] | None = None) -> Float[Tensor, "N 2"]:
    """Centres of the pixels that have depth, row by row."""
    mask = has_depth(inputs) if where is None else has_depth(inputs) & where
    return pixel_grid(inputs.camera, device=inputs.frame.depth_m.device)[mask]


def values_at(
    image: Shaped[Tensor, "H W *C"],
    uv: Float[Tensor, "N 2"],
) -> Shaped[Tensor, "N *C"]:
    """Values of an image at the pixels that contain ``uv``, which must lie inside it."""
    i, j = uv.floor().long().unbind(-1)
    return image[j, i]


def normals(inputs: SeedInputs) -> Float[Tensor, "H W 3"]:
    """Surface normals of the depth image, camera frame, zero where unknown."""
    return cached_result(
        inputs, "normals", lambda: depth_to_normals(inputs.camera, inputs.frame.depth_m)
    )


def normals_W(inputs: SeedInputs) -> Float[Tensor, "H W 3"]:
    """Surface normals of the depth image, world frame, zero where unknown."""
    return cached_result(
        inputs, "normals_W", lambda: se3.rotate(inputs.frame.T_WC, normals(inputs))
    )


def edges(
    inputs: SeedInputs, low: float, high: float, dilate_px: int, euclidean: bool
) -> Bool[Tensor, "H W"]:
    """Pixels on Canny's edges."""
    return cached_result(
        inputs,
        ("edges", low, high, dilate_px, euclidean),
        lambda: canny(inputs.frame, low, high, dilate_px, euclidean),
    )


def quadtree_cells(inputs: SeedInputs, **overrides: Any) -> Cells:
    """Leaves of the quadtree on the frame's colours, cut to the largest size, by the settings or
    what replaces them."""
    config = inputs.config
    settings = {
        "threshold": config.quadtree_threshold,
        "min_cell_px": config.quadtree_min_cell_px,
        "contrast": config.quadtree_contrast,
        "largest_m": config.quadtree_largest_m,
    }
    unknown = sorted(set(overrides) - set(settings))
    if unknown:
        raise ArgumentError(
            f"quadtree_cells: unknown settings {unknown}; known: {sorted(settings)}"
        )
    settings |= overrides
    return cached_result(inputs, ("cells", *settings.values()), lambda: _leaves(inputs, **settings))


def _leaves(inputs: SeedInputs, *, largest_m: float, **settings: Any) -> Cells:
    leaves = quadtree(inputs.frame.rgb_u8, **settings)
    if largest_m == 0:
        return leaves
    is_filled = inputs.config.without_depth == "sides"
    depth_m = filled_depth(inputs) if is_filled else inputs.frame.depth_m
    return cut_to_size(
        leaves,
        inputs.camera,
        depth_m,
        largest_m,
        min_cell_px=settings["min_cell_px"],
    )


def filled_depth(inputs: SeedInputs) -> Float[Tensor, "H W"]:
    """The frame's depth, where it is missing that of the measured pixels around
    (``depth_from_sides``). [H, W]"""
    depth_m = inputs.frame.depth_m
    if not (depth_m <= 0).any():
        return depth_m

    def fill() -> Float[Tensor, "H W"]:
        return torch.where(depth_m > 0, depth_m, depth_from_sides(depth_m, has_depth(inputs)))

    return cached_result(inputs, "filled_depth", fill)


def leaf_seeds(
    inputs: SeedInputs, *, thickness: float | None, opacity: float | None, **overrides: Any
) -> Seeds:
    """One seed per quadtree leaf whose middle has depth (GSFusion III-B.2, Eq. 10): a disc in the
    surface that covers its leaf in the picture, or round where ``thickness`` is 1."""
    frame = inputs.frame
    config = inputs.config
    thickness = config.thickness if thickness is None else thickness
    leaves = quadtree_cells(inputs, **overrides)
    rows, pixel = _measured_rows(inputs, leaves.centre_uv, frame.depth_m)
    leaves = leaves[rows]
    xyz_W, scale_m = cell_gaussians(inputs.camera, leaves, frame.depth_m, frame.T_WC)
    rgb = frame.rgb.flatten(0, 1)[pixel]
    seeds = Seeds.isotropic(
        xyz_W,
        rgb,
        scale_m,
        opacity=config.opacity if opacity is None else opacity,
        tag=leaves.level,
    )
    if thickness == 1:
        return seeds
    discs = as_discs(inputs, seeds, normals_W(inputs).flatten(0, 1)[pixel], thickness)
    return over_cells(inputs, discs, leaves)


def seeds_at(
    inputs: SeedInputs,
    uv: Float[Tensor, "N 2"],
    radius_px: Float[Tensor, " N"] | float,
    *,
    opacity: float,
    tag: Int[Tensor, " N"] | None,
    depth_m: Float[Tensor, "H W"] | None,
) -> Seeds:
    """Round seeds on the measured surface at image positions: T_WC (z K^-1 uv), z radius_px /
    fx."""
    frame = inputs.frame
    depth_m = frame.depth_m if depth_m is None else depth_m
    rows, pixel = _measured_rows(inputs, uv, depth_m)
    uv = uv[rows]
    z = depth_m.flatten()[pixel]
    size = radius_px[rows] if isinstance(radius_px, Tensor) else radius_px
    xyz_C = backproject(inputs.camera, uv.to(z.dtype), z)
    return Seeds.isotropic(
        se3.apply(frame.T_WC, xyz_C),  # GSFusion Eq. 10
        frame.rgb.flatten(0, 1)[pixel],
        z * size / inputs.camera.fx,
        opacity=opacity,
        tag=None if tag is None else tag[rows],
    )


def _is_measured(inputs: SeedInputs, depth_m: Float[Tensor, "*N"]) -> Bool[Tensor, "*N"]:
    # the smallest depth that is not missing
    near_m = max(inputs.near_m or 0.0, torch.finfo(depth_m.dtype).tiny)
    return depth_m >= near_m


def _measured_rows(
    inputs: SeedInputs, uv: Float[Tensor, "N 2"], depth_m: Float[Tensor, "H W"]
) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
    """Which image positions have depth, and the number of the pixel around each of these."""
    camera = inputs.camera
    i, j = uv.floor().long().unbind(-1)
    column = i.clamp(0, camera.width - 1)
    row = j.clamp(0, camera.height - 1)
    pixel = torch.add(column, row, alpha=camera.width)
    is_inside = (i == column) & (j == row)
    rows = (is_inside & _is_measured(inputs, depth_m.flatten()[pixel])).nonzero()[:, 0]
    return rows, pixel[rows]
