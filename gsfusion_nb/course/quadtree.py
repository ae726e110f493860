"""Exercises of chapter 3: contrast of a cell, splitting, the recursion."""

import math

import torch
from torch import Tensor

from ..seeding.quadtree import LUMA_WEIGHTS, QUADTREE_NORMALISER, Cell, Cells, cut, quadtree
from .attempt import as_rows
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


def _contrast(cell_rgb: Tensor, image_pixels: int) -> float:
    variance = cell_rgb.double().flatten(0, 1).var(dim=0, correction=0)
    V = 0.2989 * variance[0] + 0.5870 * variance[1] + 0.1140 * variance[2]
    return float(V) * image_pixels / 9e7


def _contrast_of_grey(cell_rgb: Tensor, image_pixels: int) -> float:
    grey = cell_rgb.double() @ torch.tensor(LUMA_WEIGHTS, dtype=torch.float64)
    return float(grey.var(correction=0)) * image_pixels / QUADTREE_NORMALISER


def _contrast_as_deviation(cell_rgb: Tensor, image_pixels: int) -> float:
    return math.sqrt(_contrast(cell_rgb, image_pixels))


def _contrast_with_n_minus_1(cell_rgb: Tensor, image_pixels: int) -> float:
    n = cell_rgb.shape[0] * cell_rgb.shape[1]
    return _contrast(cell_rgb, image_pixels) * n / max(n - 1, 1)


def _contrast_without_pixels(cell_rgb: Tensor, image_pixels: int) -> float:
    return _contrast(cell_rgb, 76800)


def _as_luma_variance(yours: Yours, rgb: Tensor) -> float:
    """The contrast is the variance times the image's pixels / 9e7: that of an image of 9e7 pixels
    is the variance."""
    pixels = int(QUADTREE_NORMALISER)
    return float(
        yours(
            rgb,
            pixels,
            gives={"the contrast": torch.zeros((), dtype=torch.float64)},
        )
    )


@exercise(
    chapter=3,
    difficulty=2,
    minutes=10,
    solution=_contrast,
    becomes=Becomes("luma_variance", _as_luma_variance),
    hints=(
        "One variance per colour channel, over all pixels of the cell. cell_rgb is uint8: convert "
        "first.",
        "Divide by the number of pixels, not by one less: var(..., correction=0).",
        "0.2989 var(R) + 0.5870 var(G) + 0.1140 var(B), times image_pixels / 9e7.",
    ),
    wrong=(
        Wrong(_contrast_of_grey, says="colours of the same brightness"),
        Wrong(_contrast_as_deviation, says="variance, not its root"),
        Wrong(_contrast_with_n_minus_1, says="divided by the number of pixels"),
        Wrong(_contrast_without_pixels, says="pixels of the whole image"),
    ),
)
def contrast(attempt: Attempt) -> None:
    """The contrast that decides whether a cell is split."""
    attempt.on("a cell of one colour")
    plain = torch.full((4, 4, 3), 90, dtype=torch.uint8)
    attempt.close(attempt(plain, 90_000), 0.0, "a plain cell has no contrast", tolerance=1e-9)
    mixture = torch.zeros(4, 4, 3, dtype=torch.uint8)
    mixture[:2, :, 0] = 255
    mixture[2:, :, 1] = 130
    right = (0.2989 * 127.5**2 + 0.5870 * 65.0**2) / 1000
    got = float(
        attempt.on("half red (255, 0, 0), half green (0, 130, 0): almost the same brightness")(
            mixture, 90_000
        )
    )
    prop = "different colours of the same brightness have contrast, too"
    attempt.holds(got > 1e-4 * right, prop, detail=f"got {got:.4g}, expected {right:.4g}")
    doubled_contrast = (
        float(attempt.on("the same cell in images of 90,000 and 180,000 pixels")(mixture, 180_000))
        / got
    )
    prop = (
        "it is a variance, not its root, times the pixels of the whole image: twice the pixels, "
        "twice the contrast"
    )
    attempt.holds(
        abs(doubled_contrast - 2) < 1e-3, prop, detail=f"it grows {doubled_contrast:.3g} times"
    )
    attempt.on(
        "half of the cell 80, half 100 in red, green and blue constant, image of 90,000 pixels"
    )
    red = plain.clone()
    red[:2, :, 0] = 80
    red[2:, :, 0] = 100
    prop = "the variance is divided by the number of pixels, and red weighs 0.2989"
    attempt.close(attempt(red, 90_000), 0.2989 * 100 / 1000, prop, tolerance=1e-4)
    attempt.on("the cell half red, half green")
    attempt.close(
        attempt(mixture, 90_000), right, "green weighs 0.5870, blue 0.1140", tolerance=1e-4
    )
    attempt.on("a cell of 5 x 7 random pixels, image of 90,000 pixels")
    noise = torch.randint(
        0,
        256,
        (7, 5, 3),
        generator=torch.Generator().manual_seed(3),
        dtype=torch.uint8,
    )
    prop = "V = 0.2989 var(R) + 0.5870 var(G) + 0.1140 var(B) over all pixels of the cell"
    attempt.close(attempt(noise, 90_000), _contrast(noise, 90_000), prop, tolerance=1e-4)


def _split(
    x0: int,
    y0: int,
    width: int,
    height: int,
) -> list[Cell]:
    w = width // 2
    h = height // 2
    return [
        (x0, y0, w, h),
        (x0, y0 + h, w, height - h),
        (x0 + w, y0, width - w, h),
        (x0 + w, y0 + h, width - w, height - h),
    ]


def _split_all_floor(
    x0: int,
    y0: int,
    width: int,
    height: int,
) -> list[Cell]:
    w = width // 2
    h = height // 2
    return [(x0 + i * w, y0 + j * h, w, h) for i in (0, 1) for j in (0, 1)]


def _as_cut(
    yours: Yours,
    x0: int,
    y0: int,
    width: int,
    height: int,
) -> list[Cell]:
    parts = yours(
        x0,
        y0,
        width,
        height,
        gives={"the four parts": torch.zeros(4, 4, dtype=torch.int64)},
    )
    return [(x, y, w, h) for x, y, w, h in parts.tolist()]


@exercise(
    chapter=3,
    difficulty=1,
    minutes=5,
    solution=_split,
    becomes=Becomes("cut", _as_cut),
    hints=(
        "The left and the upper part get the floor of the half.",
        "The right part gets what is left: width - width // 2.",
    ),
    wrong=(Wrong(_split_all_floor, says="every pixel"),),
)
def split_cell(attempt: Attempt) -> None:
    """Split a cell into four."""
    names = ("four cells: top left", "bottom left", "top right", "bottom right")
    for cell in ((0, 0, 8, 4), (3, 2, 6, 4), (10, 20, 7, 5), (1, 4, 9, 15)):
        parts = attempt.unpack(
            as_rows(attempt.on(f"the cell (x0, y0, width, height) = {cell}")(*cell)), names
        )
        coverage = torch.zeros(64, 64, dtype=torch.int64)
        for part in parts:
            x, y, w, h = (int(a) for a in attempt.unpack(part, ("x0", "y0", "width", "height")))
            coverage[y : y + h, x : x + w] += 1
        x, y, w, h = cell
        patch = coverage[y : y + h, x : x + w]
        times = (
            f"{int((patch == 0).sum())} pixels in none, {int((coverage > 1).sum())} in more "
            "than one"
        )
        whole = bool((patch == 1).all()) and int(coverage.sum()) == w * h
        attempt.holds(whole, "every pixel of the cell is in exactly one part", detail=times)
        got = [tuple(map(int, p)) for p in parts]
        attempt.holds(
            got == cut(*cell), "left and top parts get the floor of the half", detail=f"got {got}"
        )


def _leaves(rgb_u8: Tensor, threshold: float, min_cell_px: int) -> list[Cell]:
    H, W = rgb_u8.shape[:2]
    leaves = []

    def visit(x0: int, y0: int, w: int, h: int) -> None:
        large = w // 2 > min_cell_px and h // 2 > min_cell_px
        if large and _contrast(rgb_u8[y0 : y0 + h, x0 : x0 + w], H * W) > threshold:
            for part in _split(x0, y0, w, h):
                visit(*part)
        else:
            leaves.append((x0, y0, w, h))

    visit(0, 0, W, H)
    return leaves


def _leaves_by_full_size(rgb_u8: Tensor, threshold: float, min_cell_px: int) -> list[Cell]:
    return _leaves(rgb_u8, threshold, max(min_cell_px // 2, 1))


def _leaves_and_inner_nodes(rgb_u8: Tensor, threshold: float, min_cell_px: int) -> list[Cell]:
    H, W = rgb_u8.shape[:2]
    return [(0, 0, W, H), *_leaves(rgb_u8, threshold, min_cell_px)]


def _cut_what_is_plain(rgb_u8: Tensor, threshold: float, min_cell_px: int) -> list[Cell]:
    return [(0, 0, rgb_u8.shape[1], rgb_u8.shape[0])]


def _as_quadtree(
    yours: Yours,
    rgb_u8: Tensor,
    *,
    threshold: float = 0.1,
    min_cell_px: int = 1,
    contrast: str = "released",
) -> Cells:
    """Yours as ``Cells``, in the library's order; a threshold for the standard deviation becomes
    one for its square."""
    H, W = rgb_u8.shape[:2]
    if contrast == "std":  # sqrt(V) / 255 > t  is  V (H W) / 9e7 > (255 t)^2 (H W) / 9e7
        threshold = (255 * threshold) ** 2 * (H * W) / QUADTREE_NORMALISER
    inputs = (rgb_u8, threshold, min_cell_px)
    try:
        cells = {(int(x), int(y), int(w), int(h)) for x, y, w, h in yours(*inputs)}
    except (TypeError, ValueError):
        yours.fail("must return a list of cells (x0, y0, width, height), and did not", inputs)

    def leaves(cell: Cell, level: int) -> list[tuple[int, ...]]:
        if cell in cells:
            return [(*cell, level)]
        if min(cell[2:]) < 2:
            yours.fail(
                f"returned leaves that do not tile the image: none contains the cell {cell}", inputs
            )
        return [leaf for part in cut(*cell) for leaf in leaves(part, level + 1)]

    rows = torch.tensor(
        leaves((0, 0, W, H), 0),
        dtype=torch.int32,
        device=rgb_u8.device,
    )
    if len(rows) != len(cells):
        yours.fail(
            f"returned {len(cells)} leaves, of which only {len(rows)} come from splitting the "
            "image",
            inputs,
        )
    x0, y0, width, height, level = rows.T.contiguous()
    return Cells(x0=x0, y0=y0, width=width, height=height, level=level)


@exercise(
    chapter=3,
    difficulty=4,
    minutes=20,
    solution=_leaves,
    becomes=Becomes("quadtree", _as_quadtree),
    goes_on_with=("contrast", "split_cell"),
    hints=(
        "A function visit(x0, y0, w, h) that either appends the cell or visits its four parts.",
        "Cut if w // 2 > min_cell_px and h // 2 > min_cell_px and the contrast is above the "
        "threshold.",
        "image_pixels is that of the whole image at every level. Start with visit(0, 0, W, H).",
    ),
    wrong=(
        Wrong(_leaves_by_full_size, says="half sizes stay above min_cell_px = 5"),
        Wrong(_leaves_and_inner_nodes, says="exactly one leaf"),
        Wrong(_cut_what_is_plain, says="is split"),
    ),
)
def quadtree_leaves(attempt: Attempt) -> None:
    """The recursion: all leaves of an image's quadtree."""
    g = torch.Generator().manual_seed(0)
    noise = torch.randint(
        0,
        256,
        (20, 28, 3),
        generator=g,
        dtype=torch.uint8,
    )
    plain = torch.full((20, 28, 3), 128, dtype=torch.uint8)
    half = torch.where(
        torch.arange(28)[None, :, None] < 14,
        plain,
        noise,
    )
    got = set(as_cells(attempt, attempt.on("an image of one grey")(plain, 0.01, 1)))
    attempt.holds(
        got == {(0, 0, 28, 20)}, "a plain image stays one cell", detail=f"got {len(got)} cells"
    )
    cells = set(as_cells(attempt, attempt.on("an image of noise")(noise, 0.001, 5)))
    attempt.holds(len(cells) > 1, "a busy image is split", detail=f"got {len(cells)} cell")
    coverage = torch.zeros(20, 28, dtype=torch.int64)
    for x, y, w, h in cells:
        coverage[y : y + h, x : x + w] += 1
    detail = f"{int((coverage != 1).sum())} pixels are not"
    attempt.holds((coverage == 1).all(), "every pixel is in exactly one leaf", detail=detail)
    small = [c for c in cells if min(c[2], c[3]) < 6]
    prop = "half sizes stay above min_cell_px = 5"
    attempt.holds(
        not small, prop, detail=f"there is a leaf of {small[0][2:] if small else ''} pixels"
    )
    wide = "an image half grey, half noise"
    tall = "the same image, turned by 90 degrees"
    parents = (
        "a cell is split where its contrast is above the threshold, and its four parts are "
        "those of split_cell"
    )
    whole = "image_pixels is that of the whole image at every level"
    limit = "both halves of a cell stay above min_cell_px, the width and the height"
    cases = (
        (wide, 0.001, 1, parents),
        (wide, 0.5, 1, parents),
        (wide, 0.012, 1, whole),
        (wide, 0.001, 2, limit),
        (tall, 0.001, 1, parents),
        (tall, 0.001, 3, limit),
    )
    for case, threshold, least, prop in cases:
        image = half if case == wide else half.transpose(0, 1).contiguous()
        cells = quadtree(image, threshold=threshold, min_cell_px=least)
        reference = set(
            zip(
                *(c.tolist() for c in (cells.x0, cells.y0, cells.width, cells.height)),
                strict=True,
            )
        )
        got = set(as_cells(attempt, attempt.on(case)(image, threshold, least)))
        detail = (
            f"threshold {threshold}, min_cell_px {least}: {len(got)} leaves, expected "
            f"{len(reference)}"
        )
        attempt.holds(got == reference, prop, detail=detail)


def as_cells(attempt: Attempt, value: object) -> list[Cell]:
    """The cells that a student's function returned, as whole numbers.

    Raises:
        Failed: it is no list, or a row of it is no cell.
    """
    value = as_rows(value)
    attempt.holds(
        isinstance(value, (list, tuple)),
        "it returns a list of cells",
        detail=f"got a {type(value).__name__}",
    )
    rows = [attempt.unpack(c, ("x0", "y0", "width", "height")) for c in value]  # pyright: ignore[reportGeneralTypeIssues]
    return [(int(x), int(y), int(w), int(h)) for x, y, w, h in rows]
