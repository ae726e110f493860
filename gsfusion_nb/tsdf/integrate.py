"""Fold one RGB-D frame into the volume (GSFusion III-B.1, Eq. 6-9; Curless & Levoy 1996)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import op
from ..constants import BLOCK_VOXELS, VOXELS_PER_BLOCK
from ..geometry import se3
from ..types import Frame
from .allocate import allocate
from .volume import TsdfVolume

CHUNK_BLOCKS = 128
"""Blocks integrated at a time: their temporaries (about 10 x 256 kB) stay in the cache, which is what makes it fast."""

MISSING = -1e9
"""Stands for "no depth": the signed distance to it is behind every band, so such a pixel updates nothing."""

_EPS_M = 1e-4
"""Voxels nearer to the camera plane than this are not projected."""


@dataclass(frozen=True, kw_only=True)
class IntegrateReport:
    """What one frame did to the volume."""

    new_blocks: int
    """Blocks allocated."""
    touched_blocks: int
    """Blocks in view that were not wholly hidden, whose voxels were projected."""
    updated_voxels: int
    """Voxels that received an observation."""


def tsdf_update(
    D: Float[Tensor, "*V"],
    W: Float[Tensor, "*V"],
    sdf_m: Float[Tensor, "*V"],
    *,
    truncation_m: float,
    max_weight: float,
) -> tuple[Float[Tensor, "*V"], Float[Tensor, "*V"]]:
    """Fold one signed-distance observation into every voxel in front of ``-truncation_m``.

    d = clamp(sdf / eps, -1, 1) (Eq. 7);  W <- min(w_max, W + 1) (Eq. 8);  D <- (D (W - 1) + d) / W.
    The last is the ordinary running mean, as the released code has it: observations 0.2, 0.4, 0.6 give 0.2, 0.3, 0.4.
    Eq. 9 as printed weights the new value by w_k instead of 1 and would give 0.2, 0.3333, 0.4933.

    Args:
        D: Truncated signed distance, in units of the truncation distance. [V], any shape
        W: Observation count. [V]
        sdf_m: New signed distance, metres, positive in front of the surface, finite. [V]
        truncation_m: Half width eps of the band, metres.
        max_weight: Cap w_max on ``W``.

    Returns:
        Updated ``(D, W)``; voxels behind the band keep theirs.

    Differentiable: no (the map is state, not a parameter).
    """
    in_band = (sdf_m > -truncation_m).to(D.dtype)
    d = (sdf_m * (1.0 / truncation_m)).clamp_(-1.0, 1.0)
    W_next = (W + 1.0).clamp_(max=max_weight)
    # The mean as a step towards d, whose size is 0 outside the band: masks by `where` cost several times more on a CPU.
    return torch.addcmul(D, in_band / W_next, d.sub_(D)), torch.addcmul(W, in_band, W_next - W)


def integrate(volume: TsdfVolume, frame: Frame) -> IntegrateReport:
    """Allocate what ``frame`` needs and update every voxel that it observes; the volume changes in place.

    A voxel is observed when its centre projects into the image, the pixel that contains the projection has depth, and
    the voxel is not further than the truncation behind it. Voxels in front, however far, are observed as free (D = 1).

    Raises:
        ValueError: the pose is not rigid. MemoryError: no room for the new blocks.

    Differentiable: no (the map is state, not a parameter).
    """
    new_rows = allocate(volume, frame)
    touched, updated = fuse_frame_(volume, frame)
    return IntegrateReport(new_blocks=new_rows.shape[0], touched_blocks=touched, updated_voxels=updated)


@op("integrate")
def fuse_frame_(volume: TsdfVolume, frame: Frame) -> tuple[int, int]:
    """Update the allocated voxels that ``frame`` observes, in place.

    Returns:
        Blocks whose voxels were projected, a number that depends on how tightly hidden blocks are told; and voxels
        that received an observation.
    """
    view = FrameView(volume, frame)
    rows = visible_blocks(volume, view)
    updated = 0
    for i in range(0, rows.shape[0], CHUNK_BLOCKS):
        updated += fuse_blocks_(rows[i : i + CHUNK_BLOCKS], volume, view)
    return rows.shape[0], updated


class FrameView:
    """A frame made ready for lookups: images with a border of one missing pixel, flat; the voxel grid in camera axes.

    (U, V, Z) of a point are its homogeneous pixel coordinates, pixel = (U / Z, V / Z), with one added for the border.
    They are affine in the point, so a block's voxels are the block's corner plus 512 offsets that no block changes.
    """

    def __init__(self, volume: TsdfVolume, frame: Frame):
        camera, config = frame.camera, volume.config
        H, W = camera.height, camera.width
        self.camera, self.width, self.height = camera, W + 2, H + 2
        known = (frame.depth_m > 0) & (frame.depth_m >= config.near_m) & (frame.depth_m < float("inf"))
        self.depth_m = frame.depth_m.new_full((H + 2, W + 2), MISSING)
        self.depth_m[1:-1, 1:-1] = frame.depth_m.masked_fill(~known, MISSING)
        self.rgb = frame.rgb.new_zeros(3, H + 2, W + 2)
        self.rgb[:, 1:-1, 1:-1] = frame.rgb.permute(2, 0, 1)
        self.rgb = self.rgb.view(3, -1)
        self.T_CW = se3.inverse(frame.T_WC.double())
        axis = (torch.arange(BLOCK_VOXELS, device=volume.device, dtype=torch.float64) + 0.5) * config.voxel_size_m
        grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
        self.offset_C = se3.rotate(self.T_CW, grid)
        self.offset_UVZ = self.homogeneous(self.offset_C)

    def homogeneous(self, xyz_C: Float[Tensor, "N 3"]) -> Float[Tensor, "3 N"]:
        """(U, V, Z) of camera-frame points, float32. GSFusion Eq. 4 before the division."""
        x, y, z = xyz_C.unbind(1)
        c = self.camera
        return torch.stack([c.fx * x + (c.cx + 1) * z, c.fy * y + (c.cy + 1) * z, z]).to(torch.float32)

    def block_corners(self, volume: TsdfVolume, rows: Int[Tensor, " B"]) -> Float[Tensor, "B 3"]:
        """Lower corners of blocks, camera frame, float64."""
        return se3.apply(self.T_CW, volume.block_coords.index_select(0, rows).double() * volume.block_size_m)


def visible_blocks(volume: TsdfVolume, view: "FrameView") -> Int[Tensor, " K"]:
    """Rows of the blocks that meet the view frustum and are not wholly behind the band of everything seen there."""
    config, camera = volume.config, view.camera
    side = volume.block_size_m
    R = view.T_CW[:3, :3]
    corner = se3.apply(view.T_CW, volume.block_coords.double() * side)
    x, y, z = (corner + 0.5 * side * R.sum(1)).to(torch.float32).unbind(1)
    radius = 0.5 * side * 3**0.5
    half_z = float(0.5 * side * R[2].abs().sum())
    seen = (z > -half_z) & (z < config.far_m + config.truncation_m + half_z)
    for p, f, low, high in (
        (x, camera.fx, -camera.cx, camera.width - camera.cx),
        (y, camera.fy, -camera.cy, camera.height - camera.cy),
    ):
        # Signed distance of the centre to the two side planes of the frustum, f p = low z and f p = high z.
        seen &= (f * p - low * z > -radius * (f * f + low * low) ** 0.5) & (
            high * z - f * p > -radius * (f * f + high * high) ** 0.5
        )
    rows = seen.nonzero()[:, 0]
    centre = torch.stack([x[rows], y[rows], z[rows]], dim=1)
    farthest = _farthest_depth(view, centre, radius)
    return rows[centre[:, 2] - half_z < farthest + config.truncation_m]


def _farthest_depth(view: "FrameView", centre_C: Float[Tensor, "N 3"], radius: float) -> Float[Tensor, " N"]:
    """Upper bound of the depth seen around each bounding sphere, from a pyramid of maxima.

    A sphere's image fits in a square of side s; on the pyramid level whose tiles are at least s wide, the square
    touches at most 2 x 2 tiles.
    """
    camera = view.camera
    U, V, Z = view.homogeneous(centre_C.double())
    z = Z.clamp_min(_EPS_M)
    u, v = U / z, V / z
    # |x'/z' - x/z| <= r (1 + |x/z|) / (z - r) for a point (x', z') of the sphere.
    tangent = radius / (Z - radius).clamp_min(_EPS_M)
    slope = 1 + centre_C[:, :2].abs().amax(1) / z
    reach = max(camera.fx, camera.fy) * slope * tangent + 1
    result = torch.full_like(z, MISSING)
    level, tiles = 8, _max_pool(view.depth_m, 8)
    pending = torch.ones_like(z, dtype=torch.bool)
    while True:
        last = max(tiles.shape) == 1
        rows = (pending if last else pending & (2 * reach <= level)).nonzero()[:, 0]
        if rows.shape[0]:
            lo_u, hi_u = (_tile(u[rows] + s * reach[rows], level, tiles.shape[1]) for s in (-1, 1))
            lo_v, hi_v = (_tile(v[rows] + s * reach[rows], level, tiles.shape[0]) for s in (-1, 1))
            corners = [tiles[i, j] for i in (lo_v, hi_v) for j in (lo_u, hi_u)]
            result[rows] = torch.stack(corners).amax(0)
            pending[rows] = False
        if last:
            return result
        level, tiles = level * 2, _max_pool(tiles, 2)


def _tile(pixel: Tensor, level: int, n: int) -> Tensor:
    return (pixel / level).clamp_(0, n - 1).to(torch.int64)


def _max_pool(image: Float[Tensor, "H W"], k: int) -> Float[Tensor, "h w"]:
    return torch.nn.functional.max_pool2d(image[None], k, ceil_mode=True)[0]


def fuse_blocks_(rows: Int[Tensor, " B"], volume: TsdfVolume, view: "FrameView") -> int:
    """Update the voxels of some blocks from a view, in place; returns how many were observed."""
    config = volume.config
    corner_C = view.block_corners(volume, rows)
    b = view.homogeneous(corner_C)
    U, V, Z = (b[i, :, None] + view.offset_UVZ[i] for i in range(3))
    if float(Z.amin()) < _EPS_M:
        U = U.masked_fill_(Z < _EPS_M, -1.0)
        Z = Z.clamp_min_(_EPS_M)
    inv_z = Z.reciprocal()
    # The pixel that contains the projection; anything outside lands on the border of missing pixels.
    u = U.mul_(inv_z).clamp_(0, view.width - 1).to(torch.int32)
    v = V.mul_(inv_z).clamp_(0, view.height - 1).to(torch.int32)
    pixel = u.add_(v, alpha=view.width).view(-1)
    depth = view.depth_m.view(-1).index_select(0, pixel).view(Z.shape)
    sdf_m = depth.sub_(Z)  # Eq. 6
    if config.sdf == "ray":
        sdf_m.mul_(_range_m(corner_C, view.offset_C)).mul_(inv_z)  # the released code: (depth - z) |p| / z
    D, W = volume.D.index_select(0, rows), volume.W.index_select(0, rows)
    D_new, W_new = tsdf_update(D, W, sdf_m, truncation_m=config.truncation_m, max_weight=config.max_weight)
    observed = sdf_m > -config.truncation_m
    updated = int(observed.sum())
    if updated:
        volume.D.index_copy_(0, rows, D_new)
        volume.W.index_copy_(0, rows, W_new)
        colour = view.rgb.index_select(1, pixel).view(3, -1, VOXELS_PER_BLOCK).transpose(0, 1)
        rgb = volume.rgb_planes.index_select(0, rows)
        step = observed / W_new.clamp_min(1.0)  # 0 / 0 where never observed
        rgb.addcmul_(step[:, None], colour.sub_(rgb))
        volume.rgb_planes.index_copy_(0, rows, rgb)
    return updated


def _range_m(corner_C: Float[Tensor, "B 3"], offset_C: Float[Tensor, "V 3"]) -> Float[Tensor, "B V"]:
    """Distance from the camera of corner + offset: |c + o|^2 = |c|^2 + 2 c.o + |o|^2, one matrix product."""
    c, o = corner_C.to(torch.float32), offset_C.to(torch.float32)
    squares = (c * c).sum(1)[:, None] + (o * o).sum(1)
    return squares.addmm_(c, o.T, alpha=2.0).clamp_min_(0.0).sqrt_()
