"""What one RGB-D frame does to the values of voxels (GSFusion III-B.1, Eq. 6-9; Curless & Levoy
1996)."""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..backends import piece
from ..config import TsdfConfig
from ..geometry import project
from ..types import Frame
from .volume import TsdfSample

INT16_ONE = 32767.0
"""D = 1 in the 16-bit integers of the released code."""

LEAST_COLOUR_WEIGHT = 1e-3
"""Of a colour, also one from outside the band, as long as the voxel has had little."""

LITTLE_COLOUR = 49.5 * LEAST_COLOUR_WEIGHT
"""A voxel whose weight of colour is below this has had little: less than fifty colours from outside
the band. The limit is halfway between 49 and 50 of them, because their sum in float32 is not
exact."""

NEAREST_COLOUR_M = 0.1
"""Colours seen from nearer count as from here."""


@piece
def tsdf_update(
    D: Float[Tensor, "*V"],
    W: Float[Tensor, "*V"],
    sdf_m: Float[Tensor, "*V"],
    *,
    truncation_m: float,
    max_weight: float,
    average: Literal["mean", "eq9", "int16"] = "mean",
) -> tuple[Float[Tensor, "*V"], Float[Tensor, "*V"]]:
    """Add one signed-distance observation to every voxel that is not behind the truncation band
    (Eq. 7-9).

    Eq. 9 as printed weights the new value d by w_k, but the released code weights it by 1, which
    makes D the mean of all observations: after 0.2, 0.4 and 0.6, D is 0.2, 0.3 and 0.4; with the
    printed equation 0.2, 0.3333 and 0.4933.

    Args:
        D: Truncated signed distance before, tsdf_{k-1}, in units of the truncation distance. Any
            shape [V]
        W: Observation count before, w_{k-1}. [V]
        sdf_m: New signed distance, metres, positive in front of the surface; -inf where nothing was
            measured. [V]
        truncation_m: Half width eps of the band, metres.
        max_weight: Cap w_max on the count, at least 1.
        average: "mean" of all observations; "eq9" as printed; "int16": the mean with D, d and the
            result truncated to multiples of 1/32767, as in the released code, so that D no longer
            follows changes below w_max / 32767 once W has reached w_max.

    Returns:
        ``D`` and ``W`` after, tsdf_k and w_k; voxels behind the band keep theirs.

    Differentiable: no (the map is state, not a parameter).
    """
    d = (sdf_m / truncation_m).clamp(-1.0, 1.0)  # Eq. 7
    W_k = (W + 1.0).clamp(max=max_weight)  # Eq. 8
    if average == "eq9":
        D_k = (D * W + d * W_k) / (W + W_k)  # Eq. 9 as printed
    elif average == "int16":
        stored = (D * INT16_ONE).round()
        new = (d * INT16_ONE).trunc()
        D_k = ((stored * (W_k - 1.0) + new) / W_k).trunc() / INT16_ONE
    else:
        D_k = (D * (W_k - 1.0) + d) / W_k  # Eq. 9, the new value with weight 1
    in_band = sdf_m > -truncation_m
    return D_k.where(in_band, D), W_k.where(in_band, W)


def colour_weight(
    sdf_m: Float[Tensor, "*V"],
    z_m: Float[Tensor, "*V"],
    W_rgb: Float[Tensor, "*V"],
    config: TsdfConfig,
) -> Float[Tensor, "*V"]:
    """How much a colour counts in the mean of a voxel; 0: not at all.

    The weight is 1 at the surface and falls to 0 at the border of the band, because there the pixel
    shows another place than the voxel if it is seen at an angle; with "equal" weights it is 1 in
    the whole band. It also falls with the square of the distance, as the number of pixels that see
    the voxel does. A voxel that has had little colour takes any, if only with the least weight:
    raycasts interpolate between voxels of which some are outside every band.

    Args:
        sdf_m: Signed distance of the voxel, metres. [V]
        z_m: Depth of the voxel, metres; positive. [V]
        W_rgb: Weight of its colour before. [V]
        config: Which of the two weights are used, and how wide the band is.

    Differentiable: no (the map is state, not a parameter).
    """
    w = torch.ones_like(W_rgb)
    if config.colour_by_distance:
        w = z_m.to(w).clamp(min=NEAREST_COLOUR_M) ** -2
    if config.colour_band_voxels > 0:
        inside = 1.0 - sdf_m.to(w).abs() / (config.colour_band_voxels * config.voxel_size_m)
        falls = config.colour_weights == "falling"
        w = w * (inside.clamp(min=0.0) if falls else (inside >= 0).to(w))
    return torch.where(W_rgb < LITTLE_COLOUR, w.clamp(min=LEAST_COLOUR_WEIGHT), w)


@piece
def signed_distance_m(
    depth_m: Float[Tensor, "*V"], centres_C: Float[Tensor, "*V 3"], config: TsdfConfig
) -> Float[Tensor, "*V"]:
    """Signed distance of voxels from the measured surface, metres, positive in front (Eq. 6).

    Args:
        depth_m: Depth of the pixel that contains each voxel's projection, metres. [V]
        centres_C: Their centres, camera frame, metres. [V, 3]
        config: Definition of the distance: along z or along the ray.

    Returns:
        The distance; without meaning where the depth is missing or z is not positive. [V]

    Differentiable: no (the map is state, not a parameter).
    """
    z = centres_C[..., 2]
    sdf_m = depth_m - z  # Eq. 6
    if config.sdf == "ray":
        # not in the paper: the released code measures along the ray
        sdf_m = sdf_m * centres_C.norm(dim=-1) / z
    return sdf_m


def fuse_voxels(
    before: TsdfSample, centres_C: Float[Tensor, "*V 3"], frame: Frame, config: TsdfConfig
) -> tuple[TsdfSample, Bool[Tensor, "*V"]]:
    """Values of voxels after a frame is fused, and which of the voxels it observes.

    Args:
        before: Their values before.
        centres_C: Their centres, camera frame, metres, float64. [V, 3]
        frame: Depth and colour.
        config: Range, truncation, and definition of the distance.
    """
    camera = frame.camera
    z = centres_C[..., 2]
    u, v = project(camera, centres_C).unbind(-1)  # Eq. 4
    in_width = (u >= 0) & (u < camera.width)
    in_height = (v >= 0) & (v < camera.height)
    in_image = (z > 0) & in_width & in_height
    u = u.where(in_image, 0).long()  # the pixel that contains the projection
    v = v.where(in_image, 0).long()
    depth_m = frame.depth_m[v, u]
    sdf_m = signed_distance_m(depth_m, centres_C, config)
    in_range = (depth_m >= config.near_m) & (depth_m < torch.inf)
    measured = in_image & (depth_m > 0) & in_range
    sdf_m = sdf_m.where(measured, -torch.inf).to(before.D.dtype)

    band = {
        "truncation_m": config.truncation_m,
        "max_weight": config.max_weight,
        "average": config.average,
    }
    D_k, W_k = tsdf_update(before.D, before.W, sdf_m, **band)
    observed = sdf_m > -config.truncation_m
    W_rgb = W_k  # the mean; the paper does not define colour
    step = 1.0 / W_k
    if config.weighs_colours:
        w = colour_weight(sdf_m, z, before.W_rgb, config).where(observed, 0.0)
        W_rgb = (before.W_rgb + w).clamp(max=config.max_weight)
        step = (w / W_rgb.clamp(min=LEAST_COLOUR_WEIGHT)).clamp(max=1.0)
    rgb_k = before.rgb + step[..., None] * (frame.rgb[v, u] - before.rgb)
    return TsdfSample(
        D=D_k,
        W=W_k,
        rgb=rgb_k.where(observed[..., None], before.rgb),
        W_rgb=W_rgb,
    ), observed
