"""What moved since a map was made: surfaces that a recording sees through are taken out of the map.

A point of the map is seen through where the measured depth is clearly larger than its own, also in
the pixels around. One frame is no evidence: depth has outliers, and a pose is a little wrong. So
each voxel at a surface, and each Gaussian, counts the views that see through it, and those that see
a surface there are taken from the count. Views that count are taken from different places. What
appears needs no extra work: it is fused and seeded like anything new.
"""

import dataclasses
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry import se3
from ..optim import Keyframe
from ..tsdf.block_pool import BLOCK_VOXELS, VOXELS_PER_BLOCK
from ..types import Camera, Frame

VIEWS = 3
"""Views that must see through a point, more than see a surface there."""
APART_M = 0.05
APART_DEG = 5.0
APART_FRAMES = 10
"""A view counts if it is so far from the last one that did, or so many frames later."""
MARGIN_M = 0.05
MARGIN_PER_M2 = 5e-3
"""Depth is clearly larger by the first, and by the second times its square: three standard
deviations of a Kinect."""
AT_SURFACE_VOXELS = 1.0
"""Voxels that are less than this in front of a surface, or behind it, are a part of it."""
SHOWN_SHARE = 0.01
"""A keyframe of the earlier recording in which this share of the pixels shows what was taken out is
no longer optimised."""
SPLAT_PX = 3
"""A voxel covers this many pixels in each direction, when a keyframe is looked at."""
_COUNT = "seen_through"
"""The count of each Gaussian (``GaussianModel.row_memory``)."""


class MovedSurfaces:
    """Takes surfaces out of a mapper's map that its frames see through, or keeps them.

    Args:
        mapper: The ``Mapper``, with the map of an earlier recording.
        keeps: Nothing is taken out. Voxels of the earlier recording that a frame sees through get
            back the values that they had, because fusion would fade them.
    """

    def __init__(self, mapper: Any, *, keeps: bool = False):
        self._mapper = mapper
        volume = getattr(mapper, "volume", None)
        self.kept: tuple[Tensor, Tensor] | None = None
        """Distances and weights of the volume as it was, if all is kept."""
        self.keeps = keeps
        if keeps and volume is not None:
            self.kept = volume.D.clone(), volume.W.clone()
        self._votes = torch.zeros(0, dtype=torch.uint8, device=mapper.device)
        """Views that see through each voxel, as the volume stores them."""
        self._last: tuple[int, Tensor] | None = None
        """Number of mapped frames and pose at the last view that counted."""
        self.n_voxels = 0
        self.n_gaussians = 0
        self.n_keyframes = 0
        """What was taken out so far."""

    def look(self, frame: Frame) -> None:
        """Count the frame that was mapped last, and take out what enough views have seen
        through."""
        device = self._mapper.device
        T_WC = self._mapper.trajectory.poses[-1].to(device)
        frame = dataclasses.replace(frame.to(device), T_WC=T_WC)
        if self.keeps:
            self._restore_voxels(View(frame))
            return
        if not self._counts(frame):
            return
        view = View(frame)
        xyz_W = self._clear_voxels(view)
        self._remove_gaussians(view)
        if len(xyz_W):
            self._drop_keyframes(xyz_W)

    def in_words(self) -> str:
        """A sentence on what was taken out; "" if nothing was."""
        if not (self.n_voxels or self.n_gaussians):
            return ""
        keyframes = ""
        if self.n_keyframes:
            keyframes = f"; {self.n_keyframes} keyframes that show them are no longer optimised"
        return (
            f"the recording saw through {self.n_voxels:,} voxels and {self.n_gaussians:,} "
            f"Gaussians of the map, which were taken out{keyframes} (--keep-moved leaves all)"
        )

    def _counts(self, frame: Frame) -> bool:
        """Whether the view is another one than the last that counted."""
        n = self._mapper.n_frames
        T_WC = frame.T_WC_cpu
        if self._last is not None and n < self._last[0] + APART_FRAMES:
            angle_deg, distance_m = se3.motion(self._last[1], T_WC)
            if angle_deg < APART_DEG and distance_m < APART_M:
                return False
        self._last = n, T_WC.clone()
        return True

    def _restore_voxels(self, view: "View") -> None:
        """Give voxels that the view sees through the values that they had."""
        if self.kept is None:
            return
        volume = self._mapper.volume
        D, W = self.kept
        flat, xyz_W = surface_voxels(volume, view, D, W, 1.0)
        is_through, _ = see(view, xyz_W)
        flat = flat[is_through]
        volume.D.view(-1)[flat] = D.view(-1)[flat]
        volume.W.view(-1)[flat] = W.view(-1)[flat]

    def _clear_voxels(self, view: "View") -> Float[Tensor, "N 3"]:
        """Count the voxels at surfaces; those that were seen through become free. Returns their
        places."""
        volume = getattr(self._mapper, "volume", None)
        if volume is None or not volume.n_blocks:
            return torch.zeros(0, 3, device=self._mapper.device)
        n = volume.n_blocks * VOXELS_PER_BLOCK
        self._votes = torch.cat([self._votes, self._votes.new_zeros(n - len(self._votes))])
        at_surface = AT_SURFACE_VOXELS / volume.config.truncation_voxels
        flat, xyz_W = surface_voxels(volume, view, volume.D, volume.W, at_surface)
        votes, is_moved = count(self._votes[flat], view, xyz_W)
        self._votes[flat] = votes
        flat = flat[is_moved]
        volume.D.view(-1)[flat] = 1.0
        volume.W.view(-1)[flat] = 1.0
        if volume.config.weighs_colours:
            volume.W_rgb.view(-1)[flat] = 0.0
        self.n_voxels += len(flat)
        return xyz_W[is_moved]

    def _remove_gaussians(self, view: "View") -> None:
        mapper = self._mapper
        model = mapper.gaussians
        if not len(model):
            return
        mapper.parts.take_missed_steps()
        counts = model.row_memory(_COUNT)
        votes, is_moved = count(counts.to(torch.uint8), view, model.params.xyz_W)
        model.row_memory(_COUNT).copy_(votes)
        if bool(is_moved.any()):
            kept = ~is_moved
            model.undo_log.will_change()
            model.keep(kept)
            mapper.parts.rows_changed(kept.nonzero()[:, 0])
            self.n_gaussians += int(is_moved.sum())
        mapper.parts.end_frame()

    def _drop_keyframes(self, xyz_W: Float[Tensor, "N 3"]) -> None:
        """Forget the keyframes of the earlier recording that show these points."""
        mapper = self._mapper

        def shows(keyframe: Keyframe) -> bool:
            return keyframe.index < 0 and self._share(keyframe, xyz_W) > SHOWN_SHARE

        self.n_keyframes += mapper.keyframes.drop(shows)

    def _share(self, keyframe: Keyframe, xyz_W: Float[Tensor, "N 3"]) -> float:
        """Share of a keyframe's pixels that show points: in the picture, and nothing nearer."""
        camera = keyframe.camera
        T_WC = keyframe.T_WC.to(xyz_W.device)
        x, y, z, is_inside = project_into(camera, T_WC, xyz_W)
        x, y, z = x[is_inside], y[is_inside], z[is_inside]
        share = covered_share(camera, x, y)
        if share <= SHOWN_SHARE:  # also if nothing hides them
            return share
        surface_m = self._mapper.surface(camera, T_WC).depth_m[y, x]
        is_shown = (surface_m == 0) | (z < surface_m + MARGIN_M)
        return covered_share(camera, x[is_shown], y[is_shown])

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue; the counts of Gaussians are in the model."""
        voxels = self._votes.nonzero()[:, 0]
        last = self._last
        return {
            "kept": None if self.kept is None else list(self.kept),
            "keeps": int(self.keeps),
            "voxels": voxels.cpu(),
            "votes": self._votes[voxels].cpu(),
            "n_voxels": self.n_voxels,
            "n_gaussians": self.n_gaussians,
            "n_keyframes": self.n_keyframes,
            "n_frames": 0 if last is None else last[0],
            "T_WC": None if last is None else last[1],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.keeps = bool(state["keeps"])
        kept = state["kept"]
        self.kept = None
        if kept is not None:
            D, W = (x.to(self._mapper.device) for x in kept)
            self.kept = D, W
        n = self._mapper.volume.n_blocks if hasattr(self._mapper, "volume") else 0
        device = self._mapper.device
        self._votes = torch.zeros(n * VOXELS_PER_BLOCK, dtype=torch.uint8, device=device)
        self._votes[state["voxels"].to(device)] = state["votes"].to(device)
        self.n_voxels = state["n_voxels"]
        self.n_gaussians = state["n_gaussians"]
        self.n_keyframes = state["n_keyframes"]
        T_WC = state["T_WC"]
        self._last = None if T_WC is None else (state["n_frames"], T_WC)


class View:
    """A depth image, and the nearest and the measured depth around each pixel."""

    def __init__(self, frame: Frame):
        self.camera = frame.camera
        self.T_WC = frame.T_WC
        self.depth_m = frame.depth_m
        with_gaps = torch.where(frame.depth_m > 0, frame.depth_m, torch.inf)
        self.nearest_m = -torch.nn.functional.max_pool2d(-with_gaps[None, None], 3, 1, 1)[0, 0]
        self.farthest_m = float(frame.depth_m.max())


def surface_voxels(
    volume: Any,
    view: View,
    D: Float[Tensor, "B 512"],
    W: Float[Tensor, "B 512"],
    below: float,
) -> tuple[Int[Tensor, " N"], Float[Tensor, "N 3"]]:
    """Voxels at surfaces that a view may show: place in the flattened pool, and centre, metres.

    Args:
        volume: The volume.
        view: The view.
        D, W: Distances and weights of its first B blocks.
        below: A voxel at a surface has a smaller distance than this.
    """
    device = volume.device
    size_m = volume.block_size_m
    centres = (volume.block_coords[: len(D)] + 0.5) * size_m
    _, _, z, is_inside = project_into(view.camera, view.T_WC, centres, margin_m=size_m)
    rows = (is_inside & (z < view.farthest_m + size_m)).nonzero()[:, 0]
    is_surface = (W[rows] > 0) & (D[rows] < below)
    block, voxel = is_surface.nonzero().unbind(1)
    number = torch.arange(BLOCK_VOXELS, device=device)
    in_block = torch.stack(torch.meshgrid(number, number, number, indexing="ij"), -1).view(-1, 3)
    ijk = volume.block_coords[rows[block]] * BLOCK_VOXELS + in_block[voxel]
    return rows[block] * VOXELS_PER_BLOCK + voxel, (ijk + 0.5) * volume.config.voxel_size_m


def count(
    votes: Tensor, view: View, xyz_W: Float[Tensor, "N 3"]
) -> tuple[Tensor, Bool[Tensor, " N"]]:
    """The votes of points after one more view, uint8, and which points have enough; these begin
    again at 0."""
    is_through, is_there = see(view, xyz_W)
    votes = votes.to(torch.int16) + is_through.to(torch.int16) - is_there.to(torch.int16)
    votes = votes.clamp(0, 255)
    is_moved = is_through & (votes >= VIEWS)
    return torch.where(is_moved, 0, votes).to(torch.uint8), is_moved


def covered_share(camera: Camera, x: Int[Tensor, " N"], y: Int[Tensor, " N"]) -> float:
    """Share of the pixels that points at these pixels cover."""
    mask = torch.zeros(camera.height, camera.width, device=x.device)
    mask[y, x] = 1.0
    wide = torch.nn.functional.max_pool2d(mask[None, None], SPLAT_PX, 1, SPLAT_PX // 2)
    return float(wide.mean())


def see(view: View, xyz_W: Float[Tensor, "N 3"]) -> tuple[Bool[Tensor, " N"], Bool[Tensor, " N"]]:
    """Which points a view sees through, and where it sees a surface."""
    x, y, z, is_inside = project_into(view.camera, view.T_WC, xyz_W)
    x = torch.where(is_inside, x, 0)
    y = torch.where(is_inside, y, 0)
    depth_m = view.depth_m[y, x]
    is_measured = is_inside & (depth_m > 0)
    margin_m = MARGIN_M + MARGIN_PER_M2 * depth_m.square()
    is_through = is_measured & (z < view.nearest_m[y, x] - margin_m)
    is_there = is_measured & ((z - depth_m).abs() <= margin_m)
    return is_through, is_there


def project_into(
    camera: Camera, T_WC: Float[Tensor, "4 4"], xyz_W: Float[Tensor, "N 3"], margin_m: float = 0.0
) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"], Float[Tensor, " N"], Bool[Tensor, " N"]]:
    """Pixel (x, y) and z-depth of points, and which are in the picture, or so near to it."""
    xyz_C = se3.apply(se3.inverse(T_WC), xyz_W)
    z = xyz_C[:, 2]
    ahead = z.clamp_min(1e-3)
    u = camera.fx * xyz_C[:, 0] / ahead + camera.cx
    v = camera.fy * xyz_C[:, 1] / ahead + camera.cy
    beside_u = margin_m * camera.fx / ahead
    beside_v = margin_m * camera.fy / ahead
    is_inside = (z > -margin_m) & (u >= -beside_u) & (u < camera.width + beside_u)
    is_inside &= (v >= -beside_v) & (v < camera.height + beside_v)
    if not margin_m:
        is_inside &= z > 1e-3
    x = u.nan_to_num(-1).clamp(-1, camera.width).floor().long()
    y = v.nan_to_num(-1).clamp(-1, camera.height).floor().long()
    return x, y, z, is_inside
