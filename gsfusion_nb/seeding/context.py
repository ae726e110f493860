"""What a seeding rule may ask: the frame, the volume and the map, and questions about them."""

from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from ..types import RenderOutput, Seeds
from . import frame_queries, map_queries, volume_queries
from .inputs import SeedInputs
from .points import MapView, Neighbours
from .quadtree import Cells


@dataclass(frozen=True, eq=False, repr=False)
class SeedContext(SeedInputs):
    """Everything a seeding rule is given. ``SeedContext(frame)`` alone is enough for rules that
    need no map.

    The current frame is already fused into the volume (GSFusion, section III-B.2), but not yet in
    the Gaussian map. What takes time is computed when first asked for, and once. Functions of
    ``gsfusion_nb.seeding`` answer what is asked more seldom; they take the context.
    """

    def has_depth(self) -> Bool[Tensor, "H W"]:
        """Pixels whose depth can be used: not missing, and at least ``near_m``. [H, W]"""
        return frame_queries.has_depth(self)

    def pixels(self, where: Bool[Tensor, "H W"] | None = None) -> Float[Tensor, "N 2"]:
        """Centres of the pixels that have depth, row by row; of those only the ones in the mask, if
        given. [N, 2]"""
        return frame_queries.pixels(self, where)

    def values_at(
        self, image: Shaped[Tensor, "H W *C"], uv: Float[Tensor, "N 2"]
    ) -> Shaped[Tensor, "N *C"]:
        """Values of an image at the pixels that contain ``uv``, which must lie inside it. [N,
        ...]"""
        return frame_queries.values_at(image, uv)

    def normals(self) -> Float[Tensor, "H W 3"]:
        """Surface normals of the depth image, camera frame, zero where unknown."""
        return frame_queries.normals(self)

    def normals_W(self) -> Float[Tensor, "H W 3"]:
        """Surface normals of the depth image, world frame, zero where unknown."""
        return frame_queries.normals_W(self)

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
        return frame_queries.edges(self, low, high, dilate_px, euclidean)

    def quadtree_cells(self, **overrides: Any) -> Cells:
        """Leaves of the quadtree on the frame's colours, cut further where their Gaussians would be
        too large (``cut_to_size``), by the context's settings.

        Args:
            overrides: ``threshold``, ``min_cell_px``, ``contrast`` or ``largest_m``, in place of
                the settings.
        """
        return frame_queries.quadtree_cells(self, **overrides)

    def cells(
        self, *, thickness: float | None = None, opacity: float | None = None, **overrides: Any
    ) -> Seeds:
        """One seed per quadtree leaf whose middle has depth (GSFusion III-B.2, Eq. 10).

        The middle is back-projected with the depth of the pixel that contains it, and takes that
        pixel's colour; the standard deviation is d = z sqrt((w/2)^2 + (h/2)^2) / fx, and along the
        normal of the depth image ``thickness`` times d. The disc of a large leaf is as large as
        the leaf on the surface (``over_cells``). ``tag`` is the leaf's level. As published:
        ``cells(largest_m=0.0, thickness=1.0, opacity=0.5)``, whole leaves and round Gaussians.

        Args:
            thickness: In place of the setting; 1: round.
            opacity: In place of the setting.
            overrides: as for ``quadtree_cells``.
        """
        return frame_queries.leaf_seeds(self, thickness=thickness, opacity=opacity, **overrides)

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
            depth_m: Another depth image in place of the frame's, such as that of
                ``raycast_volume``. [H, W]

        Returns:
            At most N seeds, in the order of ``uv``.
        """
        return frame_queries.seeds_at(
            self, uv, radius_px, opacity=opacity, tag=tag, depth_m=depth_m
        )

    def voxel_weight(self, xyz_W: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Observation count of the voxels that contain the points; 0 where nothing was ever
        observed."""
        return volume_queries.voxel_weight(self, xyz_W)

    def tsdf(self, xyz_W: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Signed distance of the voxels that contain the points, in units of the truncation
        distance."""
        return volume_queries.tsdf(self, xyz_W)

    @property
    def map(self) -> MapView:
        """The Gaussians that exist before this frame."""
        return map_queries.map_view(self)

    def render(self) -> RenderOutput:
        """What the frame's camera sees of the current map; in a mapper that blends Gaussians over
        the surface, of both: alpha is then 1 where there is a surface, and no pixel has an
        index."""
        return map_queries.picture(self)

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
        return map_queries.nearest(self, xyz_W, k, among)

    def occupied(self, xyz_W: Float[Tensor, "M 3"], voxel_size_m: float) -> Bool[Tensor, " M"]:
        """Whether the voxel that contains each point holds the centre of a Gaussian of the map. [M]

        The voxels are those of a grid at the world's origin and are independent of the TSDF.
        Keeping only points in voxels that are not occupied, and of those the ones of
        ``first_in_voxel``, gives one Gaussian a voxel in the whole map, as long as the optimisation
        does not move them into another voxel.

        Args:
            xyz_W: Points, world frame, metres. [M, 3]
            voxel_size_m: Edge length of a voxel, metres.
        """
        return map_queries.occupied_voxels(self, xyz_W, voxel_size_m)
