"""What a seeding rule may read: frame, volume and map. Derived quantities are computed when first
asked for."""

import functools
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from ..config import DiscConfig, SeedingConfig, TsdfConfig
from ..errors import ArgumentError
from ..geometry import backproject, depth_to_normals, pixel_grid, quaternion, se3
from ..render import (
    BaseView,
    Boxes,
    OverBaseOutput,
    SurfaceView,
    drawn_in_part,
    render,
    render_over_base,
    view_surface,
)
from ..render.disc import PUBLISHED_DISCS
from ..tsdf import RaycastOutput, TsdfVolume, raycast
from ..types import Camera, Frame, GaussianParams, RenderOutput, Seeds
from .image_features import (
    SMALLEST_LEVEL_PX,
    EdgeDirection,
    absolute_laplacian,
    canny,
    gradient_length,
    luma,
    orb_corners,
    structure_directions,
)
from .points import MapView, Neighbours, k_nearest, nearest_others, view_map, voxel_keys
from .quadtree import Cells, cell_gaussians, quadtree

V = TypeVar("V")


@dataclass(frozen=True, eq=False)
class SeedContext:
    """Everything a seeding rule is given. ``SeedContext(frame)`` alone is enough for rules that
    need no map.

    The current frame is already fused into the volume (GSFusion, section III-B.2), but not yet in
    the Gaussian map.
    """

    frame: Frame
    """The frame that the seeds are made from."""
    volume: Any = None
    """TSDF volume (``TsdfVolume`` or ``FusedView``), for ``voxel_weight``, ``tsdf`` and
    ``voxel_index``."""
    gaussians: Any = None
    """Gaussian map, for ``map`` and ``render``: an object whose ``params`` is a GaussianParams."""
    _: KW_ONLY
    config: SeedingConfig = field(default_factory=SeedingConfig)
    """Quadtree settings."""
    generator: torch.Generator = field(default_factory=lambda: torch.Generator().manual_seed(0))
    """The only source of randomness a rule may use."""
    discs: DiscConfig = PUBLISHED_DISCS
    """When a ray counts as hitting a Gaussian, for ``surface``."""
    near_m: float | None = None
    """Depth below this counts as missing, metres. Default: the volume's setting, or 0.4 m
    (published) without one."""
    memory: dict[str, Any] = field(default_factory=dict)
    """What rules of this mapper keep from one frame to the next, by name: tensors and plain values.
    The mapper's own dict, not a copy; it is saved in checkpoints."""
    starts_submap: bool = False
    """The first frame of the map, and the first of each submap if the rule has submaps
    (``seeding.submaps``)."""
    seen_before: bool = False
    """An earlier keyframe was taken from nearly the same pose, so the frame shows nothing new
    (GPS-SLAM)."""
    keyframes: tuple[Any, ...] = ()
    """The keyframes so far, oldest first. Each has ``index`` (of the frame in the source), ``rgb``
    [H, W, 3] 0..1, ``rgb_u8``, ``camera``, ``T_WC``, and ``depth_m``, which is None if the mapper
    keeps no depth (GSFusion). They may be on the CPU while the frame is on a GPU;
    ``keyframe.to(device)``."""
    past_T_WC: tuple[Float[Tensor, "4 4"], ...] = ()
    """Camera-to-world poses of the frames mapped before this one, oldest first, on the CPU,
    corrected where a loop was closed."""
    below: BaseView | None = None
    """The surface as the frame's camera sees it, before this frame is fused, in a mapper whose
    picture is the surface with Gaussians over it (GPS-SLAM); else None."""
    boxes: Boxes | None = None
    """Of the map, to draw only the part that the camera may see."""
    params_now: Callable[[Int[Tensor, " R"] | None], GaussianParams] | None = None
    """What a mapper gives for ``params``."""
    all_in_view: bool = False
    """Whether ``surface`` draws also what is far behind the measured depth
    (``SystemConfig.all_in_view``)."""
    _cache: dict = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self):
        if self.near_m is None:
            settings = TsdfConfig() if self.volume is None else self.volume.config
            object.__setattr__(self, "near_m", float(settings.near_m))

    def __repr__(self) -> str:
        has = [name for name in ("volume", "gaussians") if getattr(self, name) is not None]
        size = f"{self.camera.width} x {self.camera.height}"
        return (
            f"SeedContext(frame {self.frame.index}, {size}, "
            f"{' and '.join(has) or 'neither volume nor gaussians'})"
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
    def step_count(self) -> int:
        """Gradient steps of the map so far; in RTG-SLAM the number of frames. 0 if the map does not
        count."""
        return getattr(self.gaussians, "step_count", 0)

    def has_depth(self) -> Bool[Tensor, "H W"]:
        """Pixels whose depth can be used: not missing, and at least ``near_m``. [H, W]"""
        return self._is_used(self.frame.depth_m)

    def _is_used(self, depth_m: Float[Tensor, "*N"]) -> Bool[Tensor, "*N"]:
        # the smallest depth that is not missing
        near_m = max(self.near_m or 0.0, torch.finfo(depth_m.dtype).tiny)
        return depth_m >= near_m

    def normals(self) -> Float[Tensor, "H W 3"]:
        """Surface normals of the depth image, camera frame, zero where unknown."""
        return self._once("normals", lambda: depth_to_normals(self.camera, self.frame.depth_m))

    def normals_W(self) -> Float[Tensor, "H W 3"]:
        """Surface normals of the depth image, world frame, zero where unknown."""
        return self._once("normals_W", lambda: se3.rotate(self.frame.T_WC, self.normals()))

    def quadtree_cells(self, **overrides: Any) -> Cells:
        """Leaves of the quadtree on the frame's colours, by the context's settings.

        Args:
            overrides: ``threshold``, ``min_cell_px`` or ``contrast``, in place of the settings.
        """
        settings = {
            "threshold": self.config.quadtree_threshold,
            "min_cell_px": self.config.quadtree_min_cell_px,
            "contrast": self.config.quadtree_contrast,
        }
        unknown = sorted(set(overrides) - set(settings))
        if unknown:
            raise ArgumentError(
                f"quadtree_cells: unknown settings {unknown}; known: {sorted(settings)}"
            )
        settings |= overrides
        start = time.perf_counter()
        leaves = self._once(
            ("cells", *settings.values()), lambda: quadtree(self.frame.rgb_u8, **settings)
        )
        self._cache["quadtree_seconds"] = self.quadtree_seconds + time.perf_counter() - start
        return leaves

    @property
    def quadtree_seconds(self) -> float:
        """Wall time spent on quadtrees so far, seconds."""
        return self._cache.get("quadtree_seconds", 0.0)

    def cells(self, **overrides: Any) -> Seeds:
        """One round seed per quadtree leaf whose middle has depth (GSFusion III-B.2, Eq. 10).

        The middle is back-projected with the depth of the pixel that contains it, and takes that
        pixel's colour; the standard deviation is d = z sqrt((w/2)^2 + (h/2)^2) / fx; opacity 0.5;
        ``tag`` is the leaf's level.

        Args:
            overrides: as for ``quadtree_cells``.
        """
        leaves = self.quadtree_cells(**overrides)
        kept, pixel = self._measured(leaves.centre_uv, self.frame.depth_m)
        leaves = leaves[kept]
        depth_m = self.frame.depth_m
        xyz_W, scale_m = cell_gaussians(self.camera, leaves, depth_m, self.frame.T_WC)
        rgb = self.frame.rgb.flatten(0, 1)[pixel]
        return Seeds.isotropic(xyz_W, rgb, scale_m, opacity=0.5, tag=leaves.level)

    def seeds_at(
        self,
        uv: Float[Tensor, "N 2"],
        radius_px: Float[Tensor, " N"] | float,
        *,
        opacity: float = 0.5,
        tag: Int[Tensor, " N"] | None = None,
        depth_m: Float[Tensor, "H W"] | None = None,
    ) -> Seeds:
        """Round seeds on the measured surface at image positions; positions outside the image or
        without depth are dropped.

        Position T_WC (z K^-1 uv), standard deviation z radius_px / fx, z and colour of the pixel
        that contains uv.

        Args:
            uv: Continuous pixel coordinates. [N, 2]
            radius_px: Standard deviation as seen in the image, pixels. [N] or one number
            opacity: Peak opacity of every seed.
            tag: Label of every seed. [N]
            depth_m: Another depth image in place of the frame's, such as that of ``raycast()``. [H,
                W]

        Returns:
            At most N seeds, in the order of ``uv``.
        """
        depth_m = self.frame.depth_m if depth_m is None else depth_m
        kept, pixel = self._measured(uv, depth_m)
        uv = uv[kept]
        z = depth_m.flatten()[pixel]
        size = radius_px[kept] if isinstance(radius_px, Tensor) else radius_px
        xyz_W = se3.apply(
            self.frame.T_WC, backproject(self.camera, uv.to(z.dtype), z)
        )  # GSFusion Eq. 10
        return Seeds.isotropic(
            xyz_W,
            self.frame.rgb.flatten(0, 1)[pixel],
            z * size / self.camera.fx,
            opacity=opacity,
            tag=None if tag is None else tag[kept],
        )

    def _measured(
        self, uv: Float[Tensor, "N 2"], depth_m: Float[Tensor, "H W"]
    ) -> tuple[Int[Tensor, " M"], Int[Tensor, " M"]]:
        """Which image positions have depth, and the number of the pixel around each of these."""
        i, j = uv.floor().long().unbind(-1)
        column = i.clamp(0, self.camera.width - 1)
        row = j.clamp(0, self.camera.height - 1)
        pixel = torch.add(column, row, alpha=self.camera.width)
        kept = ((i == column) & (j == row) & self._is_used(depth_m.flatten()[pixel])).nonzero()[
            :, 0
        ]
        return kept, pixel[kept]

    def pixels(
        self,
        where: Bool[Tensor, "H W"] | None = None,
    ) -> Float[Tensor, "N 2"]:
        """Centres of the pixels that have depth, row by row; of those only the ones in the mask, if
        given. [N, 2]"""
        mask = self.has_depth() if where is None else self.has_depth() & where
        return pixel_grid(self.camera, device=self.frame.depth_m.device)[mask]

    def values_at(
        self, image: Shaped[Tensor, "H W *C"], uv: Float[Tensor, "N 2"]
    ) -> Shaped[Tensor, "N *C"]:
        """Values of an image at the pixels that contain ``uv``, which must lie inside it. [N,
        ...]"""
        i, j = uv.floor().long().unbind(-1)
        return image[j, i]

    def voxel_weight(self, xyz_W: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Observation count of the voxels that contain the points; 0 where nothing was ever
        observed."""
        return self._need_volume("voxel_weight").sample_nearest(xyz_W).W

    def tsdf(self, xyz_W: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Signed distance of the voxels that contain the points, in units of the truncation
        distance."""
        return self._need_volume("tsdf").sample_nearest(xyz_W).D

    def voxel_index(self, xyz_W: Float[Tensor, "N 3"]) -> Int[Tensor, "N 3"]:
        """Integer coordinates of the voxels that contain the points, floor(xyz / voxel size). [N,
        3] int64"""
        return (xyz_W / self._need_volume("voxel_index").config.voxel_size_m).floor().long()

    def raycast(self) -> RaycastOutput:
        """The surface of the TSDF that the frame's camera sees, with this frame fused into it:
        ``depth_m`` [H, W], ``normal_W`` and ``rgb`` [H, W, 3]; zero where no ray meets one. In a
        mapper it needs a copy of the volume."""
        volume = self._need_volume("raycast()")
        cast = (
            functools.partial(raycast, volume) if isinstance(volume, TsdfVolume) else volume.raycast
        )
        return self._once("raycast", lambda: cast(self.camera, self.frame.T_WC))

    def params(self, rows: Int[Tensor, " M"] | None = None) -> GaussianParams:
        """Parameters of the Gaussians that exist before this frame, before activation, to read
        only.

        Rows of a large map miss gradient steps while no view shows them. These values have the
        missed steps, ``gaussians.params`` do not.

        Args:
            rows: Some rows of the map, each once; None: all. [M]
        """
        stored = self._need_gaussians("params()")
        if self.params_now is not None:
            return self.params_now(rows)
        return stored if rows is None else stored[rows]

    @property
    def map(self) -> MapView:
        """The Gaussians that exist before this frame."""
        self._need_gaussians("map")
        return self._once(
            "map",
            lambda: view_map(self.gaussians, self.frame.index, self.params()),
        )

    def render(self) -> RenderOutput:
        """What the frame's camera sees of the current map; in a mapper that blends Gaussians over
        the surface, of both: alpha is then 1 where there is a surface, and no pixel has an
        index."""
        params = self._need_gaussians("render()")

        def draw() -> RenderOutput:
            if self.below is not None:
                return self.over_base().as_render_output(self.below.base)
            return self._drawn(lambda shown: render(shown, self.camera, self.frame.T_WC), params)

        return self._once("render", draw)

    def over_base(self) -> OverBaseOutput:
        """The picture of the current map over the surface ``below``, and the sum of the Gaussians'
        weights."""
        if self.below is None:
            raise ArgumentError(
                "over_base() needs a mapper whose picture is a surface with Gaussians over it "
                "(gps_slam)"
            )
        params = self._need_gaussians("over_base()")
        below = self.below

        def draw() -> OverBaseOutput:
            view = self.camera, self.frame.T_WC
            return self._drawn(
                lambda shown: render_over_base(shown, *view, below.base, behind_m=below.behind_m)[
                    0
                ],
                params,
            )

        return self._once("over_base", draw)

    def surface(self, rows: Int[Tensor, " M"] | None = None) -> SurfaceView:
        """What the frame's camera sees of the current map with its Gaussians as discs:
        transmittance, depth of the surface, the disc that each pixel hits.

        Args:
            rows: Draw only these Gaussians; indices in the result then refer to ``rows``. By
                default all, of a large map without those far behind the measured depth.
        """
        params = self._need_gaussians("surface()")
        depth_m = None if self.all_in_view else self.frame.depth_m

        def draw(shown: GaussianParams) -> SurfaceView:
            return view_surface(shown, self.camera, self.frame.T_WC, self.discs)

        return (
            self._once("surface", lambda: self._drawn(draw, params, depth_m))
            if rows is None
            else draw(self.params(rows))
        )

    def grey(self) -> Float[Tensor, "H W"]:
        """Brightness of the picture, 0..1: 0.2989 R + 0.587 G + 0.114 B. [H, W]"""
        return self._once("grey", lambda: luma(self.frame.rgb))

    def gradient(self) -> Float[Tensor, "H W"]:
        """Length of the gradient of the brightness, per pixel (central differences; one-sided at
        the border). [H, W]"""
        return self._once("gradient", lambda: gradient_length(self.grey()))

    def laplacian(self) -> Float[Tensor, "H W"]:
        """Sum over R, G, B of the absolute Laplacian (four neighbours), 0..12: the fine detail. [H,
        W]"""
        return self._once("laplacian", lambda: absolute_laplacian(self.frame.rgb))

    def edge_direction(self, window_px: int = 3) -> EdgeDirection:
        """How edges run through each pixel, and how clearly, from the structure tensor of the
        brightness (Foerstner and Guelch 1987).

        Args:
            window_px: Odd side of the square over which the tensor is averaged.
        """
        return self._once(
            ("edge direction", window_px), lambda: structure_directions(self.grey(), window_px)
        )

    def edges(
        self,
        low: float = 100.0,
        high: float = 200.0,
        dilate_px: int = 1,
        *,
        euclidean: bool = False,
    ) -> Bool[Tensor, "H W"]:
        """Pixels on edges (Canny 1986, as in OpenCV).

        Args:
            low, high: Thresholds of the hysteresis, for the gradient of grey levels 0..255.
            dilate_px: Edges are made this many pixels wide; 1 leaves them as they are.
            euclidean: The gradient's length is the root of gx^2 + gy^2 (OpenCV's L2gradient); else
                |gx| + |gy|, which is larger, so more edges pass the thresholds.

        Returns:
            A mask. [H, W]
        """
        return self._once(
            ("edges", low, high, dilate_px, euclidean),
            lambda: canny(self.frame, low, high, dilate_px, euclidean),
        )

    def corners(self, count: int = 1000) -> Float[Tensor, "K 2"]:
        """Positions of the strongest corners, at most ``count``, continuous pixel coordinates, at
        centres of pixels; none in an image with a side below 8 pixels. [K, 2]

        FAST corners on eight image sizes, by their Harris score, as ORB takes them (OpenCV, about 6
        ms at 320x240). Source: Rublee et al. 2011.
        """
        if min(self.frame.camera.width, self.frame.camera.height) < SMALLEST_LEVEL_PX:
            return self.frame.depth_m.new_zeros(0, 2)
        return self._once(("corners", count), lambda: orb_corners(self.frame, count))

    @property
    def has_map(self) -> bool:
        """Whether the map has any Gaussian; False also without a map."""
        return self.gaussians is not None and len(self.gaussians.params) > 0

    def nearest(
        self,
        xyz_W: Float[Tensor, "M 3"],
        k: int = 3,
        among: Literal["new", "map", "new and map"] = "new",
    ) -> Neighbours:
        """The ``k`` nearest neighbours of each point; ``nearest(xyz_W).spacing_m`` is the usual
        size of a new Gaussian.

        Args:
            xyz_W: New points, world frame, metres. [M, 3]
            k: Number of neighbours.
            among: "new": the other new points; "map": the Gaussians of the map; "new and map":
                both.

        Returns:
            ``distance_m`` and ``row``, [M, k]. Rows count the new points first, then the map's,
            with "map" only the map's.
        """
        existing = self.map.xyz_W if among != "new" and self.has_map else xyz_W[:0]
        if among != "map":
            return nearest_others(xyz_W, existing, k)
        distance, row = k_nearest(xyz_W, existing, k)
        return Neighbours(distance_m=distance, row=row.masked_fill(row == len(existing), -1))

    def occupied(
        self,
        xyz_W: Float[Tensor, "M 3"],
        voxel_size_m: float,
    ) -> Bool[Tensor, " M"]:
        """Whether the voxel that contains each point holds the centre of a Gaussian of the map. [M]

        The voxels are those of a grid at the world's origin and are independent of the TSDF.
        Keeping only points in voxels that are not occupied, and of those the ones of
        ``first_in_voxel``, gives one Gaussian a voxel in the whole map, as long as the optimisation
        does not move them into another voxel.

        Args:
            xyz_W: Points, world frame, metres. [M, 3]
            voxel_size_m: Edge length of a voxel, metres.
        """
        held = self.map.xyz_W if self.has_map else xyz_W[:0]
        return torch.isin(voxel_keys(xyz_W, voxel_size_m), voxel_keys(held, voxel_size_m))

    def first_in_voxel(
        self, xyz_W: Float[Tensor, "M 3"], voxel_size_m: float
    ) -> Bool[Tensor, " M"]:
        """True for the first of the points in each voxel. [M]"""
        keys, group = voxel_keys(xyz_W, voxel_size_m).unique(return_inverse=True)
        row = torch.arange(len(xyz_W), device=xyz_W.device)
        first = torch.full_like(keys, len(xyz_W)).scatter_reduce_(0, group, row, "amin")
        return first[group] == row

    def outliers(
        self, xyz_W: Float[Tensor, "M 3"], k: int = 40, std_ratio: float = 2.0
    ) -> Bool[Tensor, " M"]:
        """Points whose mean distance to their ``k`` nearest others exceeds the mean of all points
        by ``std_ratio`` standard deviations (the statistical outlier filter, Rusu et al. 2008).
        With fewer points, all others are the neighbours of each. [M]"""
        k = min(k, len(xyz_W) - 1)
        if k < 1:
            return torch.zeros(len(xyz_W), dtype=torch.bool, device=xyz_W.device)
        mean = nearest_others(xyz_W, xyz_W[:0], k).distance_m.mean(dim=1)
        return mean > mean.mean() + std_ratio * mean.std()

    def draw(self, n: int, count: int) -> Int[Tensor, " K"]:
        """``count`` of the numbers 0 .. n - 1 at random, without replacement, in increasing order;
        all if there are fewer. On the frame's device. [K]"""
        order = torch.randperm(n, generator=self.generator, device=self.generator.device)
        return order[: max(count, 0)].sort().values.to(self.frame.depth_m.device)

    def draw_weighted(
        self,
        weight: Float[Tensor, " N"],
        count: int,
    ) -> Int[Tensor, " K"]:
        """``count`` rows at random, without replacement, with probabilities in proportion to
        ``weight`` (>= 0), in increasing order; rows of weight 0 are never drawn, so there may be
        fewer. [K]

        The ``count`` smallest of E_i / w_i with E_i exponentially distributed have this
        distribution (Efraimidis and Spirakis 2006).
        """
        uniform = torch.rand(
            len(weight), generator=self.generator, device=self.generator.device
        ).to(weight.device)
        key = -torch.log1p(-uniform) / weight
        key = torch.where(weight > 0, key, torch.inf)
        count = min(max(count, 0), int((weight > 0).sum()))
        return key.argsort(stable=True)[:count].sort().values

    def quat_from_normals(self, normal: Float[Tensor, "M 3"]) -> Float[Tensor, "M 4"]:
        """Unit quaternions, wxyz, that turn the z axis to the normals by the smaller angle; a disc
        is then thin along z. A normal need not have unit length; a zero one gives the identity. [M,
        4]"""
        length = normal.norm(dim=1, keepdim=True)
        z = torch.zeros_like(normal)
        z[:, 2] = 1.0
        return quaternion.shortest_arc(z, torch.where(length > 0, normal / length, z))

    def _once(self, key: Any, make: Any) -> Any:
        if key not in self._cache:
            self._cache[key] = make()
        return self._cache[key]

    def _need_volume(self, what: str) -> Any:
        if self.volume is None:
            raise ArgumentError(
                f"{what} needs a TSDF volume, but this SeedContext has none: pass volume=, or use "
                "a rule (or its option coverage=False) that needs none"
            )
        return self.volume

    def _drawn(
        self,
        draw: Callable[[GaussianParams], V],
        params: GaussianParams,
        depth_m: Tensor | None = None,
    ) -> V:
        view = self.camera, self.frame.T_WC
        return drawn_in_part(draw, params, self.boxes, *view, depth_m, take=self.params)

    def _need_gaussians(self, what: str) -> GaussianParams:
        if self.gaussians is None:
            raise ArgumentError(
                f"{what} needs a Gaussian map, but this SeedContext was made without one: pass "
                "gaussians="
            )
        return self.gaussians.params
