"""The Gaussian map as a seeding rule sees it."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from ..constants import SH_C0
from ..geometry import quaternion
from ..types import GaussianParams
from .step_stats import abs_image_gradient, image_gradient, times_visible


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
    """Spherical-harmonic coefficients of the colour, K = (degree + 1)^2; coefficient 0 is the constant one."""
    tag: Int[Tensor, " N"] | None = None
    """Label that the seeding rule gave each Gaussian; None if the map does not keep it."""
    state: Int[Tensor, " N"] | None = None
    """Stable (1) or unstable (0); None if the map does not distinguish them."""
    age_frames: Int[Tensor, " N"] | None = None
    """Index of this frame minus that of the frame that seeded each Gaussian; both count the frames of the source, also
    those that are not mapped. None if the map does not keep it."""
    age_steps: Int[Tensor, " N"] | None = None
    """Steps of the map (``SeedContext.step_count``) since each Gaussian was added. None if the map does not keep it."""
    times_visible: Float[Tensor, " N"] | None = None
    """Gradient steps in which each Gaussian was visible; None unless a rule that is a class asks for it: needs
    "visibility"."""
    image_gradient: Float[Tensor, " N"] | None = None
    """Mean length of dL/d of its centre in the image over these steps, in units of half the image; None unless a rule
    that is a class asks for it: needs "image_gradients"."""
    abs_image_gradient: Float[Tensor, " N"] | None = None
    """The same with the sum of the absolute values over the pixels (``StepStats.v_uv_abs``); None unless a rule that is
    a class asks for it: needs "abs_image_gradients"."""

    @property
    def normal_W(self) -> Float[Tensor, "N 3"]:
        """Unit vector along the smallest standard deviation, world frame; its sign is arbitrary."""
        R = quaternion.to_matrix(self.quat)
        return R.gather(2, self.scale_m.argmin(dim=1)[:, None, None].expand(-1, 3, 1)).squeeze(2)

    @property
    def rgb(self) -> Float[Tensor, "N 3"]:
        """View-independent part of the colour, 0..1."""
        return (self.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1)

    def __len__(self) -> int:
        return self.xyz_W.shape[0]


def view_map(gaussians: Any, frame_index: int) -> MapView:
    """The view of a map for the frame with this index.

    Args:
        gaussians: An object whose ``params`` is a GaussianParams; a GaussianModel has the other columns as well.
        frame_index: Index of the current frame, for the ages.
    """
    params: GaussianParams = gaussians.params
    scale_m = params.log_scale.exp()
    birth_frame, birth_step = (getattr(gaussians, name, None) for name in ("birth_frame", "birth_step"))
    return MapView(
        xyz_W=params.xyz_W,
        scale_m=scale_m,
        radius_m=scale_m.sort(dim=-1).values[:, 1:].mean(dim=-1),
        opacity=params.opacity_logit.sigmoid(),
        quat=params.quat,
        sh=params.sh,
        tag=getattr(gaussians, "tag", None),
        state=getattr(gaussians, "state", None),
        age_frames=None if birth_frame is None else frame_index - birth_frame,
        age_steps=None if birth_step is None else gaussians.step_count - birth_step,
        times_visible=times_visible(gaussians) if hasattr(gaussians, "memory") else None,
        image_gradient=image_gradient(gaussians) if hasattr(gaussians, "memory") else None,
        abs_image_gradient=abs_image_gradient(gaussians) if hasattr(gaussians, "memory") else None,
    )
