"""Questions about the map before the frame: its rows, what the camera sees of them, and which are
near a point."""

from collections.abc import Callable
from typing import Literal, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..errors import ArgumentError
from ..large_maps import drawn_in_part
from ..render import (
    OverBaseOutput,
    SurfacePicture,
    SurfaceView,
    render,
    render_over_base,
    view_surface,
)
from ..render.disc import PUBLISHED_DISCS
from ..types import ALL_ROWS, GaussianParams, MapRows, RenderOutput
from .inputs import DiscInputs, SeedInputs, SurfaceInputs, cached_result
from .points import MapView, Neighbours, k_nearest, keys_of_points, nearest_others, view_map

View = TypeVar("View")


def map_params(inputs: SeedInputs, rows: MapRows = ALL_ROWS) -> GaussianParams:
    """Parameters of the Gaussians that exist before this frame, before activation, to read only.

    Rows of a large map miss gradient steps while no view shows them. These values have the missed
    steps, ``gaussians.params`` do not.

    Args:
        inputs: Of the frame.
        rows: Rows of the map.
    """
    stored_params = _stored_params(inputs, "map_params()")
    if inputs.reading.params is not None:
        return inputs.reading.params(rows)
    return stored_params[rows]


def map_view(inputs: SeedInputs) -> MapView:
    """The Gaussians that exist before this frame."""
    _stored_params(inputs, "map")
    return cached_result(
        inputs,
        "map",
        lambda: view_map(inputs.gaussians, inputs.frame.index, map_params(inputs)),
    )


def step_count(inputs: SeedInputs) -> int:
    """Gradient steps of the map so far; in RTG-SLAM the number of frames. 0 if the map does not
    count."""
    clock = getattr(inputs.gaussians, "clock", None)
    return 0 if clock is None else clock.count


def surface_inputs(inputs: SeedInputs) -> SurfaceInputs | None:
    """What GPS-SLAM adds, whose picture is the surface with Gaussians over it; None in other
    systems."""
    return inputs.system if isinstance(inputs.system, SurfaceInputs) else None


def picture(inputs: SeedInputs) -> RenderOutput:
    """What the frame's camera sees of the current map."""
    params = _stored_params(inputs, "render()")
    surface = surface_inputs(inputs)

    def draw() -> RenderOutput:
        if surface is not None:
            return picture_over_surface(inputs).as_render_output(surface.surface.base)
        return _draw_visible(
            inputs,
            params,
            lambda part: render(
                part, inputs.camera, inputs.frame.T_WC, near_m=inputs.reading.near_plane_m
            ),
        )

    return cached_result(inputs, "render", draw)


def picture_over_surface(inputs: SeedInputs) -> OverBaseOutput:
    """The picture of the current map over the surface (``SurfaceInputs.surface``), and the sum of
    the Gaussians' weights. Only in GPS-SLAM."""
    surface_part = surface_inputs(inputs)
    if surface_part is None:
        raise ArgumentError(
            "picture_over_surface() needs a mapper whose picture is a surface with Gaussians over "
            "it (gps_slam)"
        )
    params = _stored_params(inputs, "picture_over_surface()")
    surface: SurfacePicture = surface_part.surface

    def draw(part: GaussianParams) -> OverBaseOutput:
        view = inputs.camera, inputs.frame.T_WC
        output, _ = render_over_base(
            part,
            *view,
            surface.base,
            behind_m=surface.behind_m,
            near_m=inputs.reading.near_plane_m,
        )
        return output

    return cached_result(inputs, "over surface", lambda: _draw_visible(inputs, params, draw))


def disc_view(inputs: SeedInputs, rows: Int[Tensor, " M"] | None = None) -> SurfaceView:
    """What the frame's camera sees of the current map with its Gaussians as discs: transmittance,
    depth of the surface, the disc that each pixel hits.

    Args:
        inputs: Of the frame.
        rows: Draw only these Gaussians; indices in the result then refer to ``rows``. By default
            all, of a large map without those far behind the measured depth.
    """
    params = _stored_params(inputs, "disc_view()")
    discs = inputs.system.discs if isinstance(inputs.system, DiscInputs) else PUBLISHED_DISCS
    depth_m = None if inputs.reading.all_in_view else inputs.frame.depth_m

    def draw(part: GaussianParams) -> SurfaceView:
        near_m = inputs.reading.near_plane_m
        return view_surface(part, inputs.camera, inputs.frame.T_WC, discs, near_m=near_m)

    if rows is not None:
        return draw(map_params(inputs, rows))
    return cached_result(inputs, "discs", lambda: _draw_visible(inputs, params, draw, depth_m))


def nearest(
    inputs: SeedInputs,
    xyz_W: Float[Tensor, "M 3"],
    k: int,
    among: Literal["new", "map", "new and map"],
) -> Neighbours:
    """The ``k`` nearest neighbours of each point."""
    map_xyz_W = map_view(inputs).xyz_W if among != "new" and inputs.has_map else xyz_W[:0]
    if among != "map":
        return nearest_others(xyz_W, map_xyz_W, k)
    distance, row = k_nearest(xyz_W, map_xyz_W, k)
    return Neighbours(distance_m=distance, row=row.masked_fill(row == len(map_xyz_W), -1))


def occupied_voxels(
    inputs: SeedInputs, xyz_W: Float[Tensor, "M 3"], voxel_size_m: float
) -> Bool[Tensor, " M"]:
    """Whether the voxel that contains each point holds the centre of a Gaussian of the map."""
    map_xyz_W = map_view(inputs).xyz_W if inputs.has_map else xyz_W[:0]
    return torch.isin(keys_of_points(xyz_W, voxel_size_m), keys_of_points(map_xyz_W, voxel_size_m))


def _draw_visible(
    inputs: SeedInputs,
    params: GaussianParams,
    draw: Callable[[GaussianParams], View],
    depth_m: Tensor | None = None,
) -> View:
    """The result of ``draw`` for the part of the map that the camera may see."""
    return drawn_in_part(
        draw,
        params,
        inputs.reading.boxes,
        inputs.camera,
        inputs.frame.T_WC,
        depth_m,
        take=lambda rows: map_params(inputs, rows),
    )


def _stored_params(inputs: SeedInputs, query: str) -> GaussianParams:
    if inputs.gaussians is None:
        raise ArgumentError(
            f"{query} needs a Gaussian map, but this {type(inputs).__name__} was made without one: "
            "pass gaussians="
        )
    return inputs.gaussians.params
