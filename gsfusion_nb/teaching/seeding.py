"""Exercises of chapter 9: rules that keep the contract, cells by budget, and what a Pareto front is."""

import heapq
from types import SimpleNamespace

import torch
from jaxtyping import UInt8
from torch import Tensor

from ..config import SeedingConfig, TsdfConfig
from ..geometry import pixel_grid
from ..seeding import SeedContext, SeedingRule, check_contexts, check_rule
from ..types import Camera, Frame, GaussianParams, Seeds
from .exercise import Attempt, Failed, Wrong, close, exercise, holds


def _raster(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    uv = pixel_grid(ctx.camera, device=ctx.frame.depth_m.device)[step_px // 2 :: step_px, step_px // 2 :: step_px]
    return ctx.seeds_at(uv.reshape(-1, 2), step_px / 2)


def _raster_without_depth_test(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    seeds = _raster(ctx, step_px=step_px)
    origin = seeds.xyz_W.new_zeros(1, 3)
    return Seeds.isotropic(
        torch.cat([seeds.xyz_W, origin]), torch.cat([seeds.rgb, origin + 0.5]),
        torch.cat([seeds.scale_m[:, 0], origin[:, 0] + 0.1]), opacity=0.5,
    )  # fmt: skip


def _raster_of_pixels(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    return _raster(ctx, step_px=1)


def _raster_of_points(ctx: SeedContext, *, step_px: int = 8) -> Seeds:
    uv = pixel_grid(ctx.camera)[step_px // 2 :: step_px, step_px // 2 :: step_px].reshape(-1, 2)
    return ctx.seeds_at(uv, 0.5)


def _raster_positional(ctx: SeedContext, step_px: int = 8) -> Seeds:
    return _raster(ctx, step_px=step_px)


@exercise(
    chapter=9, difficulty=2, minutes=10, solution=_raster,
    hints=(
        "pixel_grid(ctx.camera) has all pixel centres, [H, W, 2]; slice it with [start::step_px, start::step_px].",
        "ctx.seeds_at(uv, radius_px) does the rest: depth, back-projection, colour, size. uv is [N, 2].",
        "A square of step_px pixels reaches step_px / 2 to each side.",
    ),
    wrong=(
        Wrong(_raster_without_depth_test, says="keeps the contract"),
        Wrong(_raster_of_pixels, says="one seed for every step_px x step_px pixels"),
        Wrong(_raster_of_points, says="as large as its square"),
        Wrong(_raster_positional, says="keyword-only"),
    ),
)  # fmt: skip
def raster_rule(attempt: Attempt) -> None:
    """A rule that seeds on a regular raster of pixels."""
    on = "a wall 2 m away, 64 x 48, every 8 pixels"
    ctx = wall_context()
    seeds = _seeds(attempt.on(on)(ctx), on)
    _contract(attempt.function)
    close(len(seeds), 48, "one seed for every step_px x step_px pixels", on=on)
    close(seeds.scale_m[:, 0], torch.full((48,), 2.0 * 4 / 60), "a seed is as large as its square: half the side",
          on=on, why="In metres that is z x radius_px / fx")  # fmt: skip
    on = "the same, every 16 pixels"
    close(len(_seeds(attempt.on(on)(ctx, step_px=16), on)), 12, "the option step_px sets the distance", on=on)


def _where_empty(ctx: SeedContext, *, max_alpha: float = 0.5) -> Seeds:
    seeds = ctx.cells()
    if len(ctx.map) == 0 or len(seeds) == 0:
        return seeds
    leaves = ctx.quadtree_cells()
    x, y = leaves.centre_uv.long().unbind(-1)
    kept = ctx.has_depth()[y, x]
    return seeds[ctx.render().alpha[y, x][kept] < max_alpha]


def _where_full(ctx: SeedContext, *, max_alpha: float = 0.5) -> Seeds:
    leaves = ctx.quadtree_cells()
    x, y = leaves.centre_uv.long().unbind(-1)
    kept = ctx.has_depth()[y, x]
    return ctx.cells()[ctx.render().alpha[y, x][kept] > max_alpha]


def _where_everything(ctx: SeedContext, *, max_alpha: float = 0.5) -> Seeds:
    return ctx.cells()


def _where_swapped(ctx: SeedContext, *, max_alpha: float = 0.5) -> Seeds:
    leaves = ctx.quadtree_cells()
    x, y = leaves.centre_uv.long().unbind(-1)
    kept = ctx.has_depth()[y, x]
    alpha = ctx.render().alpha
    wrong = alpha[x.clamp(max=alpha.shape[0] - 1), y.clamp(max=alpha.shape[1] - 1)]
    return ctx.cells()[wrong[kept] < max_alpha]


@exercise(
    chapter=9, difficulty=3, minutes=15, solution=_where_empty,
    hints=(
        "ctx.cells() proposes a seed for each quadtree leaf with depth. ctx.render().alpha [H, W] says how opaque the "
        "map is at each pixel.",
        "Where is a seed in the image? leaves = ctx.quadtree_cells(); x, y = leaves.centre_uv.long().unbind(-1).",
        "Leaves without depth gave no seed: kept = ctx.has_depth()[y, x], then alpha[y, x][kept] has a row per seed.",
    ),
    wrong=(
        Wrong(_where_full, says="an empty map"),
        Wrong(_where_everything, says="opaque already"),
        Wrong(_where_swapped, says="row y, column x"),
    ),
)  # fmt: skip
def silhouette_rule(attempt: Attempt) -> None:
    """Seed where the map is still transparent (SplaTAM's silhouette), instead of asking the TSDF."""
    on = "a wall, and an empty map"
    ctx = wall_context(covered="nothing")
    all_cells = ctx.cells()
    close(len(_seeds(attempt.on(on)(ctx), on)), len(all_cells), "with an empty map every cell is seeded", on=on)
    on = "a wall whose upper left quarter has opaque Gaussians"
    ctx = wall_context(covered="quarter")
    seeds = _seeds(attempt.on(on)(ctx), on)
    inside = (seeds.xyz_W[:, 0] < -0.2) & (seeds.xyz_W[:, 1] < -0.2)
    outside = all_cells.xyz_W[(all_cells.xyz_W[:, 0] > 0.2) | (all_cells.xyz_W[:, 1] > 0.2)]
    got = seeds.xyz_W[(seeds.xyz_W[:, 0] > 0.2) | (seeds.xyz_W[:, 1] > 0.2)]
    prop = "an image is indexed [row y, column x]: every cell of the empty part is seeded"
    close(len(got), len(outside), prop, on=on)
    holds(not inside.any(), "where the map is opaque already, nothing is seeded", on=on,
          detail=f"{int(inside.sum())} seeds lie in the covered quarter")  # fmt: skip
    _contract(attempt.function)


Leaf = tuple[int, int, int, int]


def _budget_cells(rgb_u8: UInt8[Tensor, "H W 3"], n_cells: int) -> list[Leaf]:
    """Cut the cell whose pixels differ most from its mean, in sum, until there are ``n_cells``."""
    error = _squared_error_of(rgb_u8)
    H, W = rgb_u8.shape[:2]
    heap = [(-error(0, 0, W, H), (0, 0, W, H))]
    done: list[Leaf] = []
    while heap and len(heap) + len(done) + 3 <= n_cells:
        _, (x, y, w, h) = heapq.heappop(heap)
        if w < 2 or h < 2:
            done.append((x, y, w, h))
            continue
        a, b = w // 2, h // 2
        for part in ((x, y, a, b), (x, y + b, a, h - b), (x + a, y, w - a, b), (x + a, y + b, w - a, h - b)):
            heapq.heappush(heap, (-error(*part), part))
    return done + [cell for _, cell in heap]


def _squared_error_of(rgb_u8: Tensor):
    """Sum over a cell's pixels and channels of (value - mean)^2, from integral images."""
    c = rgb_u8.double()
    table = torch.cat([c, c * c], dim=-1).cumsum(0).cumsum(1)
    table = torch.nn.functional.pad(table, (0, 0, 1, 0, 1, 0)).numpy()

    def error(x: int, y: int, w: int, h: int) -> float:
        s = table[y + h, x + w] - table[y, x + w] - table[y + h, x] + table[y, x]
        return float((s[3:] - s[:3] ** 2 / (w * h)).sum())

    return error


def _budget_by_mean(rgb_u8: Tensor, n_cells: int) -> list[Leaf]:
    """As the solution, but by the mean error of a pixel: the quadtree's own idea of contrast."""
    error = _squared_error_of(rgb_u8)
    H, W = rgb_u8.shape[:2]
    heap: list[tuple[float, Leaf]] = [(0.0, (0, 0, W, H))]
    done: list[Leaf] = []
    while heap and len(heap) + len(done) + 3 <= n_cells:
        _, (x, y, w, h) = heapq.heappop(heap)
        if w < 2 or h < 2:
            done.append((x, y, w, h))
            continue
        a, b = w // 2, h // 2
        for p in ((x, y, a, b), (x, y + b, a, h - b), (x + a, y, w - a, b), (x + a, y + b, w - a, h - b)):
            heapq.heappush(heap, (-error(*p) / (p[2] * p[3]), p))
    return done + [cell for _, cell in heap]


def _budget_by_size(rgb_u8: Tensor, n_cells: int) -> list[Leaf]:
    cells = [(0, 0, rgb_u8.shape[1], rgb_u8.shape[0])]
    while len(cells) + 3 <= n_cells:
        cells.sort(key=lambda c: c[2] * c[3])
        x, y, w, h = cells.pop()
        a, b = w // 2, h // 2
        cells += [(x, y, a, b), (x, y + b, a, h - b), (x + a, y, w - a, b), (x + a, y + b, w - a, h - b)]
    return cells


def _budget_overshooting(rgb_u8: Tensor, n_cells: int) -> list[Leaf]:
    return _budget_cells(rgb_u8, n_cells + 3)


@exercise(
    chapter=9, difficulty=4, minutes=25, solution=_budget_cells,
    hints=(
        "Keep the leaves in a heap, the one with the largest error on top: heapq with negative errors.",
        "The error of a cell is the SUM over its pixels and channels of (value - mean)^2: what the PSNR of a picture "
        "with one colour per cell adds up.",
        "Pop the worst, cut it in four (as in chapter 3), push the parts; each cut adds three cells. Stop before there "
        "would be more than n_cells.",
        "Two integral images, of c and of c^2, give the error of any cell in a few subtractions: "
        "sum c^2 - (sum c)^2 / pixels.",
    ),
    wrong=(
        Wrong(_budget_by_mean, says="sum of errors"),
        Wrong(_budget_by_size, says="sum of errors"),
        Wrong(_budget_overshooting, says="at most n_cells"),
    ),
)  # fmt: skip
def budget_cells(attempt: Attempt) -> None:
    """A quadtree that uses a given number of cells where they help most."""
    on = "an image of two halves, black and white, and 4 cells"
    halves = torch.zeros(16, 16, 3, dtype=torch.uint8)
    halves[:, 8:] = 255
    cells = _cells(attempt.on(on)(halves, 4), 16, 16, on)
    holds(len(cells) <= 4, "there are at most n_cells cells", on=on, detail=f"there are {len(cells)}")
    close(len(cells), 4, "one split gives four cells", on=on)
    on = "a plain wall with a small bright pattern, 37 x 29, and 40 cells"
    image = _busy_corner()
    cells = _cells(attempt.on(on)(image, 40), 37, 29, on)
    holds(len(cells) <= 40, "there are at most n_cells cells", on=on, detail=f"there are {len(cells)}")
    holds(len(cells) >= 37, "the budget is used up: three more would be too many", on=on, detail=f"{len(cells)} cells")
    error = _squared_error_of(image)
    got, best = (sum(error(*c) for c in some) for some in (cells, _budget_cells(image, 40)))
    holds(got <= 1.02 * best, "the cell with the largest sum of errors is split next", on=on,
          detail=f"the squared error left is {got / best:.2f} times that of this order")  # fmt: skip


def _pareto(n_gaussians: Tensor, psnr_db: Tensor) -> Tensor:
    fewer = n_gaussians[:, None] <= n_gaussians
    better = psnr_db[:, None] >= psnr_db
    strictly = (n_gaussians[:, None] < n_gaussians) | (psnr_db[:, None] > psnr_db)
    return ~(fewer & better & strictly).any(dim=0)


def _pareto_best_ratio(n_gaussians: Tensor, psnr_db: Tensor) -> Tensor:
    ratio = psnr_db / n_gaussians
    return ratio == ratio.max()


def _pareto_upside_down(n_gaussians: Tensor, psnr_db: Tensor) -> Tensor:
    return _pareto(-n_gaussians, psnr_db)


def _pareto_strict_in_both(n_gaussians: Tensor, psnr_db: Tensor) -> Tensor:
    beaten = (n_gaussians[:, None] < n_gaussians) & (psnr_db[:, None] > psnr_db)
    return ~beaten.any(dim=0)


def _pareto_against_itself(n_gaussians: Tensor, psnr_db: Tensor) -> Tensor:
    beaten = (n_gaussians[:, None] <= n_gaussians) & (psnr_db[:, None] >= psnr_db)
    return ~beaten.any(dim=0)


@exercise(
    chapter=9, difficulty=2, minutes=8, solution=_pareto,
    hints=(
        "Rule a beats rule b if it has no more Gaussians, no less PSNR, and is better in at least one of the two.",
        "n[:, None] <= n compares every rule with every rule: row a, column b.",
    ),
    wrong=(
        Wrong(_pareto_best_ratio, says="both ends"),
        Wrong(_pareto_upside_down, says="both ends"),
        Wrong(_pareto_strict_in_both, says="equally good"),
        Wrong(_pareto_against_itself, says="both ends"),
    ),
)  # fmt: skip
def pareto_rules(attempt: Attempt) -> None:
    """Which rules no other rule beats: [N] true or false."""

    def front(on: str, n: list[float], psnr: list[float]) -> list[bool]:
        got = torch.as_tensor(attempt.on(on)(torch.tensor(n), torch.tensor(psnr)))
        close(list(got.shape), [len(n)], "one answer per rule", on=on)
        return [bool(b) for b in got]

    on = "1,000 Gaussians with 20 dB, 5,000 with 25 dB, 9,000 with 24 dB"
    got = front(on, [1000.0, 5000.0, 9000.0], [20.0, 25.0, 24.0])
    holds(got[:2] == [True, True], "both ends of the front count: the smallest map and the best picture", on=on,
          detail=f"got {got}, expected [True, True, False]")  # fmt: skip
    holds(not got[2], "a rule with more Gaussians and a worse picture is beaten", on=on, detail=f"got {got}")
    on = "3,000 with 22 dB and 6,000 with 22 dB"
    got = front(on, [3000.0, 6000.0], [22.0, 22.0])
    holds(got == [True, False], "of two equally good pictures the smaller map wins", on=on, detail=f"got {got}")
    on = "two rules with the same numbers"
    holds(
        front(on, [3.0, 3.0], [22.0, 22.0]) == [True, True],
        "a rule does not beat an equal one",
        on=on,
        detail="one is missing",
    )


def wall_context(covered: str = "nothing") -> SeedContext:
    """A chequered wall 2 m away, seen by 64 x 48 pixels; "quarter": opaque Gaussians on its upper left quarter."""
    camera = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)
    j, i = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
    grey = (((i // 4) + (j // 4)) % 2).float() * 0.8 + 0.1
    frame = Frame(
        index=0, timestamp_s=0.0, rgb=grey[..., None].expand(-1, -1, 3).contiguous(),
        depth_m=torch.full((48, 64), 2.0), camera=camera, T_WC=torch.eye(4),
    )  # fmt: skip
    x, y = torch.meshgrid(torch.linspace(-1.2, -0.1, 12), torch.linspace(-0.9, -0.1, 9), indexing="xy")
    xyz = torch.stack([x, y, torch.full_like(x, 2.0)], dim=-1).reshape(-1, 3)
    if covered == "nothing":
        xyz = xyz[:0]
    n = len(xyz)
    params = GaussianParams(
        xyz_W=xyz, log_scale=torch.full((n, 3), 0.06).log(), quat=torch.tensor([1.0, 0, 0, 0]).expand(n, 4).clone(),
        opacity_logit=torch.full((n,), 4.0), sh=torch.zeros(n, 1, 3),
    )  # fmt: skip
    config = SeedingConfig(quadtree_contrast="std", quadtree_threshold=0.05)
    return SeedContext(frame, _FreshVolume(), SimpleNamespace(params=params), config=config)


class _FreshVolume:
    """Every voxel was observed once."""

    config = TsdfConfig(voxel_size_m=0.02)

    def sample_nearest(self, xyz_W: Tensor) -> SimpleNamespace:
        return SimpleNamespace(D=torch.zeros(len(xyz_W)), W=torch.ones(len(xyz_W)))


def _contract(rule: SeedingRule) -> None:
    """``check_rule`` as a property of the exercise."""
    on = f"the {len(check_contexts())} scenes of check_rule"
    try:
        check_rule(rule)
    except (AssertionError, TypeError, ValueError) as e:
        raise Failed("it keeps the contract of a rule", on, str(e)) from None
    except Exception as e:
        raise Failed("it runs", on, f"it raised {type(e).__name__}: {e}") from e


def _seeds(value: object, on: str) -> Seeds:
    if not isinstance(value, Seeds):
        raise Failed("it returns Seeds", on, f"it returned a {type(value).__name__}")
    return value


def _cells(value: object, width: int, height: int, on: str) -> list[Leaf]:
    """The student's cells, which must tile the image."""
    try:
        cells = [(int(x), int(y), int(w), int(h)) for x, y, w, h in value]  # pyright: ignore
    except (TypeError, ValueError):
        raise Failed("it returns a list of (x0, y0, width, height)", on, f"it returned {value!r:.80}") from None
    hits = torch.zeros(height, width, dtype=torch.int64)
    for x, y, w, h in cells:
        hits[y : y + h, x : x + w] += 1
    holds((hits == 1).all() and all(w > 0 and h > 0 for *_, w, h in cells), "the cells tile the image", on=on,
          detail=f"{int((hits != 1).sum())} pixels are in no cell, or in two")  # fmt: skip
    return cells


def _busy_corner() -> Tensor:
    """29 x 37: a gentle ramp everywhere, and a few single bright pixels in a corner."""
    ramp = torch.linspace(60, 160, 37).expand(29, 37)[..., None].expand(-1, -1, 3).clone()
    generator = torch.Generator().manual_seed(1)
    ramp[2:9, 2:9] += 60 * torch.rand(7, 7, 3, generator=generator)
    return ramp.round().to(torch.uint8)
