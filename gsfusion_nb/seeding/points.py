"""Points, in bulk: nearest neighbours, voxels, and what is known of each Gaussian of a map."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import op
from ..checks import check_whole
from ..gaussians import radius_of
from ..geometry import quaternion
from ..geometry.operands import check_operand
from ..geometry.spherical_harmonics import SH_C0
from ..geometry.voxel_keys import voxel_keys
from ..types import Camera, GaussianParams


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbours:
    """The nearest neighbours of M points, nearest first, never the point itself."""

    distance_m: Float[Tensor, "M K"]
    """Distance, metres; infinite where there are fewer than K neighbours."""
    row: Int[Tensor, "M K"]
    """Rows of the neighbours, -1 where there is none."""

    @property
    def spacing_m(self) -> Float[Tensor, " M"]:
        """Root mean square of the distances that exist, metres; NaN without any. The square root of
        what 3DGS calls the mean squared distance to the 3 nearest neighbours (simple-knn)."""
        exists = self.distance_m.isfinite()
        return (self.distance_m.where(exists, 0.0).square().sum(dim=1) / exists.sum(dim=1)).sqrt()


def check_points(xyz_W: Any, others_W: Any, k: Any) -> None:
    """Raise ``ValueError`` for arguments that ``k_nearest`` refuses."""
    check_operand("xyz_W", xyz_W, ("M", 3))
    check_operand(
        "others_W",
        others_W,
        ("N", 3),
        dtypes=(xyz_W.dtype,),
        device=xyz_W.device,
    )
    check_whole("k", k, 1)


@op("neighbours", check_points)
def k_nearest(
    xyz_W: Float[Tensor, "M 3"], others_W: Float[Tensor, "N 3"], k: int
) -> tuple[Float[Tensor, "M K"], Int[Tensor, "M K"]]:
    """Distance to the ``k`` nearest of ``others_W`` and their rows, nearest first; if there are
    fewer, infinite and row N. Points that are not finite, or more than 1e19 apart, are no
    neighbours. On the device of the points; differentiable: no."""
    from scipy.spatial import KDTree

    M = len(xyz_W)  # far is for what is not finite: its square overflows in float32
    N = len(others_W)
    remote = 1e30
    points = xyz_W.nan_to_num(-remote, -remote, -remote).cpu()
    others = others_W.nan_to_num(remote, remote, remote).cpu()
    # built in half the time
    tree = KDTree(others.numpy(), balanced_tree=False, compact_nodes=False)
    distance, row = (
        torch.from_numpy(x).view(M, k).to(xyz_W.device) for x in tree.query(points.numpy(), k=k)
    )
    none = ~distance.float().square().isfinite()
    return distance.masked_fill(none, torch.inf).to(xyz_W.dtype), row.masked_fill(none, N)


def nearest_others(
    xyz_W: Float[Tensor, "M 3"],
    more_W: Float[Tensor, "N 3"],
    k: int,
) -> Neighbours:
    """The ``k`` nearest neighbours of each point among the other points and ``more_W``.

    A point at the same place as another one has it as a neighbour at distance 0. Differentiable:
    no.
    """
    M = len(xyz_W)
    everything = torch.cat([xyz_W, more_W])
    distance, row = k_nearest(xyz_W, everything, k + 1)
    other = row != torch.arange(M, device=row.device)[:, None]
    other[other.all(dim=1), -1] = False  # a duplicate hid the point itself: leave out the farthest
    column = other.byte().sort(dim=1, descending=True, stable=True).indices[:, :k]
    row = row.gather(1, column)
    return Neighbours(
        distance_m=distance.gather(1, column),
        row=row.masked_fill(row == len(everything), -1),
    )


def keys_of_points(xyz_W: Float[Tensor, "N 3"], voxel_size_m: float) -> Int[Tensor, " N"]:
    """The number (``voxel_keys``) of the voxel floor(xyz / voxel size) that contains each point."""
    return voxel_keys((xyz_W / voxel_size_m).floor().long())


def first_in_voxel(xyz_W: Float[Tensor, "M 3"], voxel_size_m: float) -> Bool[Tensor, " M"]:
    """True for the first of the points in each voxel of a grid at the world's origin. [M]"""
    keys, group = keys_of_points(xyz_W, voxel_size_m).unique(return_inverse=True)
    row = torch.arange(len(xyz_W), device=xyz_W.device)
    first = torch.full_like(keys, len(xyz_W)).scatter_reduce_(0, group, row, "amin")
    return first[group] == row


def outliers(
    xyz_W: Float[Tensor, "M 3"], k: int = 40, std_ratio: float = 2.0
) -> Bool[Tensor, " M"]:
    """Points whose mean distance to their ``k`` nearest others exceeds the mean of all points by
    ``std_ratio`` standard deviations (the statistical outlier filter, Rusu et al. 2008). With fewer
    points, all others are the neighbours of each. [M]"""
    k = min(k, len(xyz_W) - 1)
    if k < 1:
        return torch.zeros(len(xyz_W), dtype=torch.bool, device=xyz_W.device)
    mean = nearest_others(xyz_W, xyz_W[:0], k).distance_m.mean(dim=1)
    return mean > mean.mean() + std_ratio * mean.std()


VISIBLE = "times_visible"
GRADIENT = "image_gradient"
ABS_GRADIENT = "abs_image_gradient"
"""Names of the numbers that are summed up for each row: steps in which it was visible, and lengths
of its ``v_uv`` and of its ``v_uv_abs``."""


def add_up(
    gaussians: Any,
    visible: Bool[Tensor, " N"],
    v_uv: Float[Tensor, "N 2"] | None,
    camera: Camera,
    v_uv_abs: Float[Tensor, "N 2"] | None = None,
) -> None:
    """Add a step to the statistics of each row of a map, which ``times_visible``,
    ``image_gradient`` and ``abs_image_gradient`` read."""
    gaussians.row_memory(VISIBLE).add_(visible)
    for name, gradient in ((GRADIENT, v_uv), (ABS_GRADIENT, v_uv_abs)):
        if gradient is not None:
            length = (gradient * gradient.new_tensor([camera.width / 2, camera.height / 2])).norm(
                dim=1
            )
            gaussians.row_memory(name).add_(torch.where(visible, length, 0.0))


def times_visible(gaussians: Any) -> Float[Tensor, " N"] | None:
    """Number of gradient steps in which each Gaussian was visible since ``restart_statistics``;
    None if not collected.

    Source: Kerbl et al. 2023, section 5.2.
    """
    return gaussians.memory.get(VISIBLE)


def image_gradient(gaussians: Any) -> Float[Tensor, " N"] | None:
    """Mean length of dL/d of each centre in the image over the steps in which it was visible; None
    if not collected.

    The unit of length in the image is half its width and half its height, as in 3DGS and gsplat,
    whose threshold 2e-4 refers to it.

    Source: Kerbl et al. 2023, section 5.2.
    """
    return _mean_over_steps(gaussians, GRADIENT)


def abs_image_gradient(gaussians: Any) -> Float[Tensor, " N"] | None:
    """Mean length of ``StepStats.v_uv_abs`` over the steps in which each Gaussian was visible; None
    if not collected.

    The unit of length in the image is that of ``image_gradient``, as in gsplat with
    ``absgrad=True``.

    Source: Ye et al. 2024 (AbsGS).
    """
    return _mean_over_steps(gaussians, ABS_GRADIENT)


def restart_statistics(gaussians: Any) -> None:
    """Forget what was summed up so far."""
    for name in (VISIBLE, GRADIENT, ABS_GRADIENT):
        if name in gaussians.memory:
            gaussians.memory[name].zero_()


def _mean_over_steps(gaussians: Any, name: str) -> Float[Tensor, " N"] | None:
    total = gaussians.memory.get(name)
    return None if total is None else total / gaussians.memory[VISIBLE].clamp_min(1)


@dataclass(frozen=True, kw_only=True, eq=False)
class MapView:
    """The Gaussians that exist before this frame, one row each."""

    xyz_W: Float[Tensor, "N 3"]
    """Centre, world frame, metres."""
    scale_m: Float[Tensor, "N 3"]
    """Standard deviation along the Gaussian's own axes, metres."""
    radius_m: Float[Tensor, " N"]
    """Mean of the two largest standard deviations (RTG-SLAM's radius of a disc), metres."""
    opacity: Float[Tensor, " N"]
    """Peak opacity."""
    quat: Float[Tensor, "N 4"]
    """Orientation, wxyz, not normalised."""
    sh: Float[Tensor, "N K 3"]
    """Spherical-harmonic coefficients of the colour, K = (degree + 1)^2; coefficient 0 is the
    constant one."""
    tag: Int[Tensor, " N"] | None = None
    """Label that the seeding rule gave each Gaussian; None if the map does not keep it."""
    state: Int[Tensor, " N"] | None = None
    """Stable (1) or unstable (0); None if the map does not distinguish them."""
    age_frames: Int[Tensor, " N"] | None = None
    """Index of this frame minus that of the frame that seeded each Gaussian; both count the frames
    of the source, also those that are not mapped. None if the map does not keep it."""
    age_steps: Int[Tensor, " N"] | None = None
    """Steps of the map (``step_count``) since each Gaussian was added. None if the map
    does not keep it."""
    times_visible: Float[Tensor, " N"] | None = None
    """Gradient steps in which each Gaussian was visible; None unless a rule that is a class asks
    for it: needs "visibility"."""
    image_gradient: Float[Tensor, " N"] | None = None
    """Mean length of dL/d of its centre in the image over these steps, in units of half the image;
    None unless a rule that is a class asks for it: needs "image_gradients"."""
    abs_image_gradient: Float[Tensor, " N"] | None = None
    """The same with the sum of the absolute values over the pixels (``StepStats.v_uv_abs``); None
    unless a rule that is a class asks for it: needs "abs_image_gradients"."""

    @property
    def normal_W(self) -> Float[Tensor, "N 3"]:
        """Unit vector along the smallest standard deviation, world frame; its sign is arbitrary."""
        R = quaternion.to_matrix(self.quat)
        return R.gather(
            2,
            self.scale_m.argmin(dim=1)[:, None, None].expand(-1, 3, 1),
        ).squeeze(2)

    @property
    def rgb(self) -> Float[Tensor, "N 3"]:
        """View-independent part of the colour, 0..1."""
        return (self.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1)

    def __len__(self) -> int:
        return self.xyz_W.shape[0]


def view_map(gaussians: Any, frame_index: int, params: GaussianParams | None = None) -> MapView:
    """The view of a map for the frame with this index.

    Args:
        gaussians: An object whose ``params`` is a GaussianParams; a GaussianModel has the other
            columns as well.
        frame_index: Index of the current frame, for the ages.
        params: Parameters of all rows, if others than ``gaussians.params``.
    """
    params = gaussians.params if params is None else params
    assert params is not None
    scale_m = params.log_scale.exp()
    birth_frame = getattr(gaussians, "birth_frame", None)
    clock = getattr(gaussians, "clock", None)
    return MapView(
        xyz_W=params.xyz_W,
        scale_m=scale_m,
        radius_m=radius_of(scale_m),
        opacity=params.opacity_logit.sigmoid(),
        quat=params.quat,
        sh=params.sh,
        tag=getattr(gaussians, "tag", None),
        state=getattr(gaussians, "state", None),
        age_frames=None if birth_frame is None else frame_index - birth_frame,
        age_steps=None if clock is None else clock.count - clock.birth,
        times_visible=times_visible(gaussians) if hasattr(gaussians, "memory") else None,
        image_gradient=image_gradient(gaussians) if hasattr(gaussians, "memory") else None,
        abs_image_gradient=abs_image_gradient(gaussians) if hasattr(gaussians, "memory") else None,
    )
