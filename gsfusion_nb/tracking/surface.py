"""What ICP aligns: depth frames in several sizes, and the model as a camera sees it."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_shape
from ..geometry import depth_to_normals, pixel_grid, rays, se3
from ..tsdf import TsdfVolume, raycast
from ..types import Camera

GRAZING_COSINE = 0.2
"""Surfaces at a more grazing angle (cosine below this, 78 degrees) are left out: their depth errors
are largest, and five times larger along the surface (released code of Peng et al. 2024)."""

BLOCK_JUMP = 0.05
"""Pixels of a block whose depth differs from the block's median by more than this share lie on
another surface."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthLevel:
    """A depth image of reduced size."""

    factor: int
    """One pixel stands for ``factor`` x ``factor`` of the frame's."""
    camera: Camera
    depth_m: Float[Tensor, "H W"]
    """z-depth, metres; 0 where there is none, or where ICP does not use it."""
    normal_C: Float[Tensor, "H W 3"]
    """Unit normals that face the camera, camera frame; 0 where they are not known."""


def depth_pyramid(
    depth_m: Float[Tensor, "H W"], camera: Camera, factors: tuple[int, ...]
) -> list[DepthLevel]:
    """Reduced images of a depth frame, one for each of ``factors`` (Peng et al. 2024, "Input
    pre-processing").

    Args:
        depth_m: z-depth, metres, 0 where there is none. [H, W]
        camera: Its intrinsics.
        factors: Reduction of each level; they need not divide the size.

    Differentiable: no.
    """
    check_shape("depth_m", depth_m, (camera.height, camera.width))
    depth_m = torch.where(torch.isfinite(depth_m) & (depth_m > 0), depth_m, 0.0)
    depths = {1: depth_m}
    for factor in sorted(set(factors)):
        # reducing an already reduced image is faster
        finer = max(f for f in depths if factor % f == 0)
        depths[factor] = reduce_depth(depths[finer], factor // finer)
    return [_level(depths[factor], reduced_camera(camera, factor), factor) for factor in factors]


def _level(depth_m: Tensor, camera: Camera, factor: int) -> DepthLevel:
    normal_C = depth_to_normals(camera, depth_m)
    ray = rays(camera, pixel_grid(camera, device=depth_m.device, dtype=depth_m.dtype))
    cosine = -(normal_C * ray).sum(-1) / ray.norm(dim=-1)
    usable = cosine >= GRAZING_COSINE
    return DepthLevel(
        factor=factor,
        camera=camera,
        depth_m=depth_m.where(usable, 0.0),
        normal_C=normal_C.where(usable[..., None], 0.0),
    )


def reduced_camera(camera: Camera, factor: int) -> Camera:
    """The camera with pixels ``factor`` times as large; the last ones may reach beyond the
    image."""
    return Camera(
        width=-(-camera.width // factor),
        height=-(-camera.height // factor),
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=camera.cx / factor,
        cy=camera.cy / factor,
    )


def reduce_depth(depth_m: Float[Tensor, "H W"], factor: int) -> Float[Tensor, "h w"]:
    """Harmonic mean of each block's pixels on the surface of its median; missing where less than
    half have depth.

    On a plane 1 / z is linear in the pixel, so this is the plane's depth at the block's centre. The
    noise of 1 / z of a stereo or structured-light camera is also the same at all depths. The
    maximum, which the released code uses, moves slanted surfaces back; a mean across a depth edge
    would be a point in mid-air.
    """
    if factor == 1:
        return depth_m
    H, W = depth_m.shape
    h = -(-H // factor)
    w = -(-W // factor)
    to_right = w * factor - W
    to_bottom = h * factor - H
    padded_depth = torch.nn.functional.pad(depth_m, (0, to_right, 0, to_bottom))
    rows_and_columns = padded_depth.view(h, factor, w, factor)
    block = rows_and_columns.transpose(1, 2).reshape(h, w, factor * factor)
    has_depth = block > 0
    median = block.masked_fill(~has_depth, float("nan")).nanmedian(-1, keepdim=True).values
    same = has_depth & ((block - median).abs() <= BLOCK_JUMP * median)
    inverses = (1.0 / block.clamp_min(1e-6)).where(same, 0.0)
    inverse = inverses.sum(-1) / same.sum(-1).clamp_min(1)
    enough = 2 * has_depth.sum(-1) >= factor * factor
    return (1.0 / inverse.clamp_min(1e-6)).where(enough, 0.0)


HYBRID_DEPTH_M = 0.01
HYBRID_COSINE_GAP = 0.01
"""If depths (metres) or normals (1 - cosine; 8 degrees) differ by more than this, a hybrid target
uses the last frame's own depth (released code of Peng et al. 2024)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """The model as a camera sees it; its image size may differ from that of the frames."""

    depth_m: Float[Tensor, "H W"]
    """z-depth, metres; 0 where there is none."""
    normal_W: Float[Tensor, "H W 3"]
    """Unit normal towards the camera, world frame; 0 where it is not known."""
    camera: Camera
    T_WC: Float[Tensor, "4 4"]
    """Pose that it was rendered from."""
    rgb: Float[Tensor, "H W 3"] | None = None
    """Its colours, 0..1, if the model has any; they verify the appearance after relocalisation."""

    def __post_init__(self):
        size = (self.camera.height, self.camera.width)
        check_shape("depth_m of the surface", self.depth_m, size)
        check_shape("normal_W of the surface", self.normal_W, (*size, 3))
        check_shape("T_WC of the surface", self.T_WC, (4, 4))


SurfaceSource = Callable[[Camera, Tensor], Surface]
"""Renders the model as a camera sees it from a pose ``T_WC`` [4, 4]."""


def about_the_surface(
    T_WC: Float[Tensor, "4 4"], T_WS: Float[Tensor, "4 4"], dtype: torch.dtype
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "3 3"]]:
    """The pose with its origin moved to the centre of the surface's camera, and the rotation R_WS
    of that camera.

    The difference of the centres is taken in float64: both may be far from the world's origin.
    """
    T_WS = T_WS.double().to(T_WC.device)
    return se3.translate(T_WC.double(), -T_WS[:3, 3]).to(dtype), T_WS[:3, :3].to(dtype)


def tsdf_surface(volume: TsdfVolume) -> SurfaceSource:
    """The zero crossing of a TSDF as the model to track against (KinectFusion, Newcombe et al.
    2011)."""

    def render(camera: Camera, T_WC: Tensor) -> Surface:
        surface = raycast(volume, camera, T_WC)
        return Surface(
            depth_m=surface.depth_m,
            normal_W=surface.normal_W,
            camera=camera,
            T_WC=T_WC,
            rgb=surface.rgb,
        )

    return render


def smooth_normals(model: Surface) -> Surface:
    """The same surface with each normal averaged over 3x3 pixels, for models of few noisy frames.

    The normals of a TSDF of one Kinect frame have errors of 30 degrees; averaged, they agree with
    those of the next frame. Along edges the mean mixes two surfaces, so normals of a good model are
    better without it.
    """
    has_normal = (model.normal_W != 0).any(dim=-1, keepdim=True)
    mean = torch.nn.functional.avg_pool2d(
        model.normal_W.permute(2, 0, 1), 3, stride=1, padding=1
    ).permute(1, 2, 0)
    normal_W = torch.nn.functional.normalize(mean, dim=-1).where(has_normal, 0.0)
    return dataclasses.replace(model, normal_W=normal_W)


def hybrid_surface(
    model: Surface,
    depth_m: Float[Tensor, "H W"],
    rgb: Float[Tensor, "H W 3"] | None = None,
) -> Surface:
    """The model where it agrees with the last frame, and that frame's own depth elsewhere (released
    code).

    They agree where both have depth, the depths differ by at most 1 cm and the normals by at most 8
    degrees. Normals are computed from the mixed depth.

    Args:
        model: Rendered from the pose of the last frame, with its camera.
        depth_m: z-depth of the last frame, metres. [H, W]
        rgb: Its colours, 0..1. [H, W, 3]
    """
    own_W = se3.rotate(model.T_WC.to(depth_m), depth_to_normals(model.camera, depth_m))
    is_apart = (model.depth_m - depth_m).abs() > HYBRID_DEPTH_M
    is_turned = 1 - (own_W * model.normal_W).sum(-1) > HYBRID_COSINE_GAP
    own = (depth_m > 0) & ((model.depth_m <= 0) | is_apart | is_turned)
    mixed_m = torch.where(own, depth_m, model.depth_m)
    normal_W = se3.rotate(model.T_WC.to(depth_m), depth_to_normals(model.camera, mixed_m))
    return Surface(
        depth_m=mixed_m, normal_W=normal_W, camera=model.camera, T_WC=model.T_WC, rgb=rgb
    )
