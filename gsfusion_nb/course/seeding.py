"""Exercises of chapter 9: rules that keep the contract, and Pareto fronts."""

from types import SimpleNamespace

import torch
from torch import Tensor

from ..config import SeedingConfig
from ..geometry import pixel_grid, project, se3
from ..seeding import SeedContext, SeedingRule, check_contexts, check_rule
from ..types import GaussianParams, Seeds
from .exercise import Attempt, Failed, Wrong, exercise
from .stand_ins import FreshVolume, chequered_wall


def wall_context(coverage: str = "nothing") -> SeedContext:
    """A chequered wall 2 m away, seen by 64 x 48 pixels; "quarter": opaque Gaussians on its upper
    left quarter."""
    frame = chequered_wall(square_px=4)
    x, y = torch.meshgrid(
        torch.linspace(-1.2, -0.1, 12),
        torch.linspace(-0.9, -0.1, 9),
        indexing="xy",
    )
    xyz = torch.stack([x, y, torch.full_like(x, 2.0)], dim=-1).reshape(-1, 3)
    if coverage == "nothing":
        xyz = xyz[:0]
    n = len(xyz)
    params = GaussianParams(
        xyz_W=xyz,
        log_scale=torch.full((n, 3), 0.06).log(),
        quat=torch.tensor([1.0, 0, 0, 0]).expand(n, 4).clone(),
        opacity_logit=torch.full((n,), 4.0),
        sh=torch.zeros(n, 1, 3),
    )
    config = SeedingConfig(quadtree_contrast="std", quadtree_threshold=0.05)
    return SeedContext(frame, FreshVolume(), SimpleNamespace(params=params), config=config)


def _raster(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    uv = pixel_grid(ctx.camera, device=ctx.frame.depth_m.device)[
        step_px // 2 :: step_px, step_px // 2 :: step_px
    ]
    return ctx.seeds_at(uv.reshape(-1, 2), step_px / 2)


def _raster_without_depth_test(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    seeds = _raster(ctx, step_px=step_px)
    origin = seeds.xyz_W.new_zeros(1, 3)
    return Seeds.isotropic(
        torch.cat([seeds.xyz_W, origin]),
        torch.cat([seeds.rgb, origin + 0.5]),
        torch.cat([seeds.scale_m[:, 0], origin[:, 0] + 0.1]),
        opacity=0.5,
    )


def _raster_of_pixels(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    return _raster(ctx, step_px=1)


def _raster_of_points(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    uv = pixel_grid(ctx.camera)[step_px // 2 :: step_px, step_px // 2 :: step_px].reshape(-1, 2)
    return ctx.seeds_at(uv, 0.5)


def _raster_positional(ctx: SeedContext, step_px: int = 8) -> Seeds:
    return _raster(ctx, step_px=step_px)


@exercise(
    chapter=9,
    difficulty=2,
    minutes=10,
    solution=_raster,
    hints=(
        "pixel_grid(ctx.camera) has all pixel centres, [H, W, 2]; slice it with [start::step_px, "
        "start::step_px].",
        "ctx.seeds_at(uv, radius_px) does the rest: depth, back-projection, colour, size. uv is "
        "[N, 2].",
        "A square of step_px pixels reaches step_px / 2 to each side.",
    ),
    wrong=(
        Wrong(_raster_without_depth_test, says="keeps the contract"),
        Wrong(_raster_of_pixels, says="one seed for every step_px x step_px pixels"),
        Wrong(_raster_of_points, says="as large as its square"),
        Wrong(_raster_positional, says="keyword-only"),
    ),
)
def raster_rule(attempt: Attempt) -> None:
    """A rule that seeds on a regular raster of pixels."""
    ctx = wall_context()
    check_rule(_raster)
    seeds = _seeds(attempt, attempt.on("a wall 2 m away, 64 x 48, every 8 pixels")(ctx))
    _contract(attempt.watched)
    attempt.close(len(seeds), 48, "one seed for every step_px x step_px pixels")
    attempt.close(
        seeds.scale_m[:, 0],
        torch.full((48,), 2.0 * 4 / 60),
        "a seed is as large as its square: half the side",
        why="In metres that is z x radius_px / fx",
    )
    _one_in_the_middle_of_each(attempt, seeds, ctx, 8)
    seeds = _seeds(attempt, attempt.on("the same, every 16 pixels")(ctx, step_px=16))
    attempt.close(len(seeds), 12, "the option step_px sets the distance")
    attempt.close(
        seeds.scale_m[:, 0],
        torch.full((12,), 2.0 * 8 / 60),
        "the size grows with step_px",
    )
    _one_in_the_middle_of_each(attempt, seeds, ctx, 16)


def _one_in_the_middle_of_each(
    attempt: Attempt, seeds: Seeds, ctx: SeedContext, step_px: int
) -> None:
    """Each square of the raster has its seed within a pixel of its middle, with the colour of a
    pixel there."""
    u, v = project(
        ctx.camera,
        se3.apply(se3.inverse(ctx.frame.T_WC), seeds.xyz_W),
    ).unbind(-1)
    square = (v / step_px).floor() * (ctx.camera.width // step_px) + (u / step_px).floor()
    prop = "the seeds stand on a regular raster: one in the middle of each square"
    n_cells = len(square.unique())
    attempt.holds(
        n_cells == len(seeds),
        prop,
        detail=f"{len(seeds)} seeds stand in {n_cells} different squares",
    )
    offset = torch.stack([u, v]).remainder(step_px) - step_px / 2
    worst = float(offset.abs().max())
    attempt.holds(
        worst <= 1.01, prop, detail=f"a seed is {worst:.1f} pixels beside the middle of its square"
    )
    photo = ctx.frame.rgb[v.long(), u.long()]
    attempt.close(seeds.rgb, photo, "a seed has the colour of the pixel below it", tolerance=1e-4)


def _where_empty(ctx: SeedContext, *, max_alpha: float = 0.5) -> Seeds:
    seeds = ctx.cells()
    if len(ctx.map) == 0 or len(seeds) == 0:
        return seeds
    leaves = ctx.quadtree_cells()
    x, y = leaves.centre_uv.long().unbind(-1)
    has_depth = ctx.has_depth()[y, x]
    return seeds[ctx.render().alpha[y, x][has_depth] < max_alpha]


def _where_full(ctx: SeedContext, *, max_alpha: float = 0.5) -> Seeds:
    leaves = ctx.quadtree_cells()
    x, y = leaves.centre_uv.long().unbind(-1)
    has_depth = ctx.has_depth()[y, x]
    return ctx.cells()[ctx.render().alpha[y, x][has_depth] > max_alpha]


def _where_everything(ctx: SeedContext, *, max_alpha: float = 0.5) -> Seeds:
    return ctx.cells()


def _where_swapped(ctx: SeedContext, *, max_alpha: float = 0.5) -> Seeds:
    leaves = ctx.quadtree_cells()
    x, y = leaves.centre_uv.long().unbind(-1)
    has_depth = ctx.has_depth()[y, x]
    alpha = ctx.render().alpha
    wrong = alpha[x.clamp(max=alpha.shape[0] - 1), y.clamp(max=alpha.shape[1] - 1)]
    return ctx.cells()[wrong[has_depth] < max_alpha]


@exercise(
    chapter=9,
    difficulty=3,
    minutes=15,
    solution=_where_empty,
    hints=(
        "ctx.cells() proposes a seed for each quadtree leaf with depth. ctx.render().alpha [H, W] "
        "says how opaque the map is at each pixel.",
        "Where is a seed in the image? leaves = ctx.quadtree_cells(); x, y = "
        "leaves.centre_uv.long().unbind(-1).",
        "Leaves without depth gave no seed: kept = ctx.has_depth()[y, x], then alpha[y, x][kept] "
        "has a row per seed.",
    ),
    wrong=(
        Wrong(_where_full, says="an empty map"),
        Wrong(_where_everything, says="opaque already"),
        Wrong(_where_swapped, says="row y, column x"),
    ),
)
def silhouette_rule(attempt: Attempt) -> None:
    """Seed where the map is still transparent (SplaTAM's silhouette) instead of testing the
    TSDF."""
    attempt.on("a wall, and an empty map")
    ctx = wall_context(coverage="nothing")
    all_cells = ctx.cells()
    check_rule(_where_empty)
    attempt.close(
        len(_seeds(attempt, attempt(ctx))), len(all_cells), "with an empty map every cell is seeded"
    )
    case = "a wall whose upper left quarter has opaque Gaussians"
    ctx = wall_context(coverage="quarter")
    seeds = _seeds(attempt, attempt.on(case)(ctx))
    in_corner = (seeds.xyz_W[:, 0] < -0.2) & (seeds.xyz_W[:, 1] < -0.2)
    others = all_cells.xyz_W[(all_cells.xyz_W[:, 0] > 0.2) | (all_cells.xyz_W[:, 1] > 0.2)]
    got = seeds.xyz_W[(seeds.xyz_W[:, 0] > 0.2) | (seeds.xyz_W[:, 1] > 0.2)]
    prop = "an image is indexed [row y, column x]: every cell of the empty part is seeded"
    attempt.close(len(got), len(others), prop)
    attempt.holds(
        not in_corner.any(),
        "where the map is opaque already, nothing is seeded",
        detail=f"{int(in_corner.sum())} seeds lie in the covered quarter",
    )
    for max_alpha in (0.02, 0.9, 1.1):
        attempt.on(f"{case}, max_alpha = {max_alpha}")
        got, reference = (
            len(_seeds(attempt, rule(ctx, max_alpha=max_alpha))) for rule in (attempt, _where_empty)
        )
        prop = "max_alpha is the limit: cells with a smaller alpha are seeded"
        attempt.holds(got == reference, prop, detail=f"{got} seeds, expected {reference}")
    _contract(attempt.watched)


def _pareto(n_gaussians: Tensor, psnr_db: Tensor) -> Tensor:
    fewer = n_gaussians[:, None] <= n_gaussians
    better = psnr_db[:, None] >= psnr_db
    strictly = (n_gaussians[:, None] < n_gaussians) | (psnr_db[:, None] > psnr_db)
    return ~(fewer & better & strictly).any(dim=0)


def _pareto_best_ratio(n_gaussians: Tensor, psnr_db: Tensor) -> Tensor:
    ratio = psnr_db / n_gaussians
    return ratio == ratio.max()


def _pareto_strict_in_both(n_gaussians: Tensor, psnr_db: Tensor) -> Tensor:
    beaten = (n_gaussians[:, None] < n_gaussians) & (psnr_db[:, None] > psnr_db)
    return ~beaten.any(dim=0)


@exercise(
    chapter=9,
    difficulty=2,
    minutes=8,
    solution=_pareto,
    hints=(
        "Rule a beats rule b if it has no more Gaussians, no less PSNR, and is better in at least "
        "one of the two.",
        "n[:, None] <= n compares every rule with every rule: row a, column b.",
    ),
    wrong=(
        Wrong(_pareto_best_ratio, says="both ends"),
        Wrong(_pareto_strict_in_both, says="equally good"),
    ),
)
def pareto_rules(attempt: Attempt) -> None:
    """Which rules no other rule beats: [N] true or false."""

    def front(
        case: str,
        n: list[float],
        psnr: list[float],
    ) -> list[bool]:
        got = torch.as_tensor(attempt.on(case)(torch.tensor(n), torch.tensor(psnr)))
        attempt.close(list(got.shape), [len(n)], "one answer per rule")
        return [bool(b) for b in got]

    case = "1,000 Gaussians with 20 dB, 5,000 with 25 dB, 9,000 with 24 dB"
    got = front(case, [1000.0, 5000.0, 9000.0], [20.0, 25.0, 24.0])
    attempt.holds(
        got[:2] == [True, True],
        "both ends of the front count: the smallest map and the best picture",
        detail=f"got {got}, expected [True, True, False]",
    )
    attempt.holds(
        not got[2], "a rule with more Gaussians and a worse picture is beaten", detail=f"got {got}"
    )
    got = front("3,000 with 22 dB and 6,000 with 22 dB", [3000.0, 6000.0], [22.0, 22.0])
    attempt.holds(
        got == [True, False],
        "of two equally good pictures the smaller map wins",
        detail=f"got {got}",
    )
    got = front("two maps of 3,000, with 22 and 25 dB", [3000.0, 3000.0], [22.0, 25.0])
    attempt.holds(
        got == [False, True],
        "of two equally large maps the better picture wins",
        detail=f"got {got}",
    )
    case = "two rules with the same numbers"
    attempt.holds(
        front(case, [3.0, 3.0], [22.0, 22.0]) == [True, True],
        "a rule does not beat an equal one",
        detail="one is missing",
    )


def _contract(rule: SeedingRule) -> None:
    """``check_rule`` as a property of the exercise."""
    case = f"the {len(check_contexts())} scenes of check_rule"
    try:
        check_rule(rule)
    except (AssertionError, TypeError, ValueError) as e:
        raise Failed("it keeps the contract of a rule", case, str(e)) from None
    except Failed as e:
        raise Failed(e.prop, e.on or case, e.detail) from None
    except Exception as e:
        raise Failed("it runs", case, f"it raised {type(e).__name__}: {e}") from e


def _seeds(attempt: Attempt, value: object) -> Seeds:
    if not isinstance(value, Seeds):
        raise Failed("it returns Seeds", attempt.words, f"it returned a {type(value).__name__}")
    return value
