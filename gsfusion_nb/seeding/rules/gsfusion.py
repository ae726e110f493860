"""GSFusion's rule: quadtree leaves in voxels that are seen for the first time."""

from jaxtyping import Bool, Float
from torch import Tensor

from ...backends import piece
from ...types import Seeds
from ..context import SeedContext
from ..rule import seeding_rule
from ..sampling import cells_without_depth


@seeding_rule
def gsfusion(ctx: SeedContext, *, required_weight: float = 1.0, coverage: bool = True) -> Seeds:
    """One Gaussian per quadtree leaf whose middle lies in a voxel that this frame was the first to observe.

    The voxel test runs after the frame has been integrated, so a weight of exactly 1 means "first observed now". In the
    released code as here, this has some consequences:
    - a voxel that was free space when first observed has a weight too: a surface that appears there later is never
      seeded;
    - a leaf is lost if the voxel around its middle has weight 0, because that voxel's own centre falls on a pixel
      without depth, or too far behind that pixel's depth (object borders);
    - a voxel is seeded twice if a later frame measures a point in it but does not update its weight;
    - several leaves of one frame may share a voxel.
    The last two cannot happen with ``one_per_voxel`` in the seeding settings.

    With ``without_depth = "sides"`` in the seeding settings there is also one Gaussian per leaf whose middle has no
    depth, where the map shows nothing; it has no voxel and no test (``cells_without_depth``).

    Args:
        ctx: Frame and volume.
        required_weight: Observation count that the voxel must have.
        coverage: False skips the voxel test; then every leaf with depth is seeded in every frame.

    Source: GSFusion section III-B.2, Eq. 10.
    """
    seeds = ctx.cells()
    seeds = seeds[first_seen(ctx.voxel_weight(seeds.xyz_W), required_weight)] if coverage else seeds
    return Seeds.cat([seeds, cells_without_depth(ctx)]) if ctx.config.without_depth == "sides" else seeds


@piece
def first_seen(weight: Float[Tensor, " N"], required_weight: float) -> Bool[Tensor, " N"]:
    """Which of the leaves with depth get a Gaussian, by the weight of the voxel around the middle of each."""
    return weight == required_weight
