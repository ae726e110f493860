"""What a seeding rule is given: the frame, the volume, the map, and what one system adds."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import DiscConfig, SeedingConfig, TsdfConfig
from ..large_maps import Boxes
from ..render import SurfacePicture
from ..render.constants import NEAR_PLANE_M
from ..render.disc import PUBLISHED_DISCS
from ..types import Camera, Frame, GaussianParams, MapRows

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True, eq=False)
class MapReading:
    """How the rows of a map are read, by default all of them as they are stored."""

    boxes: Boxes | None = None
    """Of the map, to draw only the part that the camera may see."""
    params: Callable[[MapRows], GaussianParams] | None = None
    """Gives rows with the gradient steps that they missed."""
    all_in_view: bool = False
    """Whether ``disc_view`` draws also what is far behind the measured depth
    (``SystemConfig.all_in_view``)."""
    near_plane_m: float = NEAR_PLANE_M
    """Nearer Gaussians are not drawn, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DiscInputs:
    """What RTG-SLAM adds, whose Gaussians are discs."""

    discs: DiscConfig = PUBLISHED_DISCS
    """When a ray counts as hitting a Gaussian, for ``disc_view``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceInputs:
    """What GPS-SLAM adds, whose picture is the surface with Gaussians over it."""

    surface: SurfacePicture
    """The surface as the frame's camera sees it, before this frame is fused."""
    seen_before: bool = False
    """An earlier keyframe was taken from nearly the same pose, so the frame shows nothing new."""


@dataclass(frozen=True, eq=False)
class SeedInputs:
    """What is known when new Gaussians are made from one frame.

    The current frame is already fused into the volume (GSFusion, section III-B.2), but not yet in
    the Gaussian map.
    """

    frame: Frame
    """The frame that the seeds are made from."""
    volume: Any = None
    """TSDF volume (``TsdfVolume`` or ``FusedView``), for ``voxel_weight``, ``tsdf``,
    ``voxel_index`` and ``raycast_volume``."""
    gaussians: Any = None
    """Gaussian map, for ``map`` and ``render``: an object whose ``params`` is a GaussianParams."""
    _: KW_ONLY
    config: SeedingConfig = field(default_factory=SeedingConfig)
    """Quadtree settings."""
    generator: torch.Generator = field(default_factory=lambda: torch.Generator().manual_seed(0))
    """The only source of randomness a rule may use."""
    near_m: float | None = None
    """Depth below this counts as missing, metres. Default: the volume's setting, or 0.4 m
    (published) without one."""
    memory: dict[str, Any] = field(default_factory=dict)
    """What rules of this mapper keep from one frame to the next, by name: tensors and plain values.
    The mapper's own dict, not a copy; it is saved in checkpoints."""
    starts_submap: bool = False
    """The first frame of the map, and the first of each submap if the rule has submaps
    (``seeding.submaps``)."""
    keyframes: tuple[Any, ...] = ()
    """The keyframes so far, oldest first. Each has ``index`` (of the frame in the source), ``rgb``
    [H, W, 3] 0..1, ``rgb_u8``, ``camera``, ``T_WC``, and ``depth_m``, which is None if the mapper
    keeps no depth (GSFusion). They may be on the CPU while the frame is on a GPU;
    ``keyframe.to(device)``."""
    past_T_WC: tuple[Float[Tensor, "4 4"], ...] = ()
    """Camera-to-world poses of the frames mapped before this one, oldest first, on the CPU,
    corrected where a loop was closed."""
    system: DiscInputs | SurfaceInputs | None = None
    """What only the system that maps has: ``DiscInputs`` (RTG-SLAM) or ``SurfaceInputs``
    (GPS-SLAM)."""
    reading: MapReading = field(default_factory=MapReading)
    """How the rows of the map are read."""
    results: dict = field(default_factory=dict, init=False, repr=False)
    """What was computed from these inputs so far (``cached_result``)."""

    def __post_init__(self):
        if self.near_m is None:
            settings = TsdfConfig() if self.volume is None else self.volume.config
            object.__setattr__(self, "near_m", float(settings.near_m))

    def __repr__(self) -> str:
        maps = [name for name in ("volume", "gaussians") if getattr(self, name) is not None]
        size = f"{self.camera.width} x {self.camera.height}"
        return (
            f"{type(self).__name__}(frame {self.frame.index}, {size}, "
            f"{' and '.join(maps) or 'neither volume nor gaussians'})"
        )

    @property
    def camera(self) -> Camera:
        """The frame's camera."""
        return self.frame.camera

    @property
    def frame_number(self) -> int:
        """Number of frames mapped before this one; 0 for the first. ``frame.index`` counts the
        source's frames."""
        return len(self.past_T_WC)

    @property
    def has_map(self) -> bool:
        """Whether the map has any Gaussian; False also without a map."""
        return self.gaussians is not None and len(self.gaussians.params) > 0


def cached_result(inputs: SeedInputs, key: Any, make: Callable[[], Result]) -> Result:
    """The result of ``make``, which is called where these inputs have none for ``key`` yet."""
    if key not in inputs.results:
        inputs.results[key] = make()
    return inputs.results[key]
