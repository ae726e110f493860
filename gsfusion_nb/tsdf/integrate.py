"""Fuse one RGB-D frame into the volume (GSFusion III-B.1, Eq. 6-9; Curless & Levoy 1996).

``FusedView`` is a preview of a volume with a frame fused into it; the volume does not change.
"""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op, piece
from ..checks import check_pose
from ..config import TsdfConfig
from ..errors import ArgumentError
from ..geometry import project, se3
from ..geometry.operands import check_frame_on, check_operand
from ..types import Camera, Frame
from .allocate import allocate, new_band_blocks
from .octree import NewBlocks
from .raycast import RaycastOutput, raycast
from .volume import TsdfSample, TsdfVolume, check_volume
from .voxels import block_corners, block_of, voxel_centres, voxels_of

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

BLOCKS_AT_A_TIME = 256
"""Limits the memory for intermediate results, independent of the size of the map."""


@dataclass(frozen=True, kw_only=True)
class IntegrateReport:
    """How one frame changed the volume."""

    new_blocks: int
    """Blocks allocated."""
    updated_voxels: int
    """Voxels that received an observation."""


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


def integrate(volume: TsdfVolume, frame: Frame) -> IntegrateReport:
    """Allocate what ``frame`` needs and update every voxel that it observes; the volume changes in
    place.

    A voxel is observed when its centre projects into the image, the pixel that contains the
    projection has depth, and the voxel is not further than the truncation behind it. Voxels in
    front, however far, are observed as free (D = 1).

    Raises:
        ValueError: the pose is not rigid. MemoryError: no room for the new blocks.

    Differentiable: no (the map is state, not a parameter).
    """
    new_rows = allocate(volume, frame)
    return IntegrateReport(new_blocks=new_rows.shape[0], updated_voxels=fuse_frame_(volume, frame))


def check_fuse(volume: Any, frame: Any) -> None:
    """Raise ``ValueError`` for arguments that ``fuse_frame_`` refuses."""
    check_volume(volume)
    check_frame_on(frame, volume.device)
    if frame.T_WC.device.type == "cpu":
        check_pose("T_WC", frame.T_WC)


def check_fuse_frame(volume: Any, frame: Any) -> None:
    """As ``check_fuse``; and a volume without any block takes nothing of a frame that needs
    some."""
    check_fuse(volume, frame)
    if not volume.n_blocks and len(new_band_blocks(volume, frame)):
        raise ArgumentError(
            "the volume has no voxel blocks, so nothing can be fused into it; integrate(volume, "
            "frame) makes those that the frame needs and fuses it"
        )


@op("integrate", check_fuse_frame)
def fuse_frame_(volume: TsdfVolume, frame: Frame) -> int:
    """Update the allocated voxels that ``frame`` observes, in place; returns how many it observes.

    It makes no blocks: ``integrate`` does, and then calls this.

    Raises:
        ValueError: the pose is not rigid; or the volume has no blocks although the frame needs
            some.
    """
    T_CW = se3.inverse(frame.T_WC.double())
    rows = blocks_in_view(volume, frame.camera, T_CW)
    return sum(_fuse_blocks(volume, part, frame, T_CW) for part in rows.split(BLOCKS_AT_A_TIME))


def blocks_in_view(
    volume: TsdfVolume, camera: Camera, T_CW: Float[Tensor, "4 4"]
) -> Int[Tensor, " K"]:
    """Rows of the blocks that may reach into the view: up to ``far_m`` and the truncation, and
    between its four sides.

    A block whose eight corners all lie outside the same side of the view is not in view.
    """
    corners_W = block_corners(volume.block_coords, volume.block_size_m)
    return corners_in_view(corners_W, volume.config, camera, T_CW).nonzero()[:, 0]


def corners_in_view(
    corners_W: Float[Tensor, "B 8 3"],
    config: TsdfConfig,
    camera: Camera,
    T_CW: Float[Tensor, "4 4"],
) -> Bool[Tensor, " B"]:
    """Which blocks, given by their corners, may reach into the view; see ``blocks_in_view``."""
    x, y, z = se3.apply(T_CW, corners_W).unbind(-1)
    within = [
        z,
        config.far_m + config.truncation_m - z,
        camera.fx * x + camera.cx * z,  # u >= 0
        (camera.width - camera.cx) * z - camera.fx * x,  # u <= width
        camera.fy * y + camera.cy * z,  # v >= 0
        (camera.height - camera.cy) * z - camera.fy * y,  # v <= height
    ]
    return torch.stack([(distance > 0).any(1) for distance in within]).all(0)


def _fuse_blocks(
    volume: TsdfVolume,
    rows: Int[Tensor, " B"],
    frame: Frame,
    T_CW: Float[Tensor, "4 4"],
) -> int:
    """Update the voxels of some blocks from a frame, in place; returns how many were observed."""
    before = TsdfSample(
        D=volume.D[rows],
        W=volume.W[rows],
        rgb=volume.rgb[rows],
        W_rgb=volume.W_rgb[rows],
    )
    centres_C = se3.apply(
        T_CW, voxel_centres(voxels_of(volume.block_coords[rows]), volume.config.voxel_size_m)
    )
    after, observed = fuse_voxels(before, centres_C, frame, volume.config)
    volume.D[rows] = after.D
    volume.W[rows] = after.W
    volume.rgb[rows] = after.rgb
    volume.W_rgb[rows] = after.W_rgb
    return int(observed.sum())


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


class FusedView:
    """Shows a volume as if ``frame`` were already fused; the volume is not changed.

    GSFusion's seeding rules need the volume with the frame fused into it. With this view they can
    run before it is fused, so that a rule that fails leaves the map unchanged.

    Args:
        volume: The volume before the frame.
        frame: The frame that will be fused.
        missing: The blocks that will be allocated for it, from ``new_band_blocks``.
    """

    def __init__(self, volume: TsdfVolume, frame: Frame, missing: NewBlocks):
        self.config = volume.config
        self._volume = volume
        self._frame = frame
        self._missing = missing

    def sample_nearest(self, xyz_W: Float[Tensor, "N 3"]) -> TsdfSample:
        """Values that the voxels containing the points will have.

        Args:
            xyz_W: Points, world frame, metres. [N, 3]

        Differentiable: no.
        """
        return sample_fused_voxels(self._volume, self._frame, self._missing, xyz_W)

    def raycast(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RaycastOutput:
        """The surface that a camera will see; computed in a copy of the volume into which the frame
        is fused.

        Raises:
            MemoryError: no room for the copy.

        Differentiable: no.
        """
        copy = self._volume.to(self._volume.device)
        copy.add_blocks(self._missing.coords)
        fuse_frame_(copy, self._frame)
        return raycast(copy, camera, T_WC)


def check_sample_fused(volume: Any, frame: Any, missing: Any, xyz_W: Any) -> None:
    """Raise ``ValueError`` for arguments that ``sample_fused_voxels`` refuses."""
    check_fuse(volume, frame)
    if not isinstance(missing, NewBlocks):
        raise ArgumentError(f"missing must be NewBlocks, got {type(missing).__name__}")
    device = volume.D.device
    check_operand(
        "codes",
        missing.codes,
        ("M",),
        dtypes=(torch.int64,),
        device=device,
    )
    check_operand(
        "coords",
        missing.coords,
        (len(missing), 3),
        dtypes=(torch.int64,),
        device=device,
    )
    check_operand("xyz_W", xyz_W, ("N", 3), device=device)


@op("sample", check_sample_fused)
def sample_fused_voxels(
    volume: TsdfVolume, frame: Frame, missing: NewBlocks, xyz_W: Float[Tensor, "N 3"]
) -> TsdfSample:
    """Values that voxels will have; the operation behind ``FusedView.sample_nearest``.

    Raises:
        ValueError: the pose is not rigid.

    Source: GSFusion III-B.1, Eq. 6-9. Differentiable: no.
    """
    T_CW = se3.inverse(frame.T_WC.double())
    before = volume.sample_nearest(xyz_W)
    ijk = volume.voxel_index(xyz_W)
    block = block_of(ijk)
    corners_W = block_corners(block, volume.block_size_m)
    in_view = corners_in_view(corners_W, volume.config, frame.camera, T_CW)
    changes = ((volume.index.find(block) >= 0) | missing.contains(block)) & in_view
    after, _ = fuse_voxels(
        before,
        se3.apply(T_CW, voxel_centres(ijk, volume.config.voxel_size_m)),
        frame,
        volume.config,
    )
    return TsdfSample(
        D=after.D.where(changes, before.D),
        W=after.W.where(changes, before.W),
        rgb=after.rgb.where(changes[:, None], before.rgb),
        W_rgb=after.W_rgb.where(changes, before.W_rgb),
    )
