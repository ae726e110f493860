"""Fit single RGB-D images with few Gaussians: disc depth compared with blended depth (Peng et al. 2024, Fig. 7)."""

import dataclasses
import statistics
from collections.abc import Iterable
from pathlib import Path

import torch

from ..checks import check_name
from ..config import rtg_slam
from ..data import open_sequence
from ..evaluation.image import psnr
from ..gaussians import SurfelModel
from ..mapping.surfel_optimiser import SurfelOptimiser, TrainingView
from ..render import view_surface
from ..render.constants import OPAQUE_ALPHA
from ..seeding import SeedContext, apply_rule
from ..types import Frame
from ..work import ProgressDisplay

COUNTS = (500, 1000, 2000, 4000, 8000)
STEPS = 150
METHODS = {
    "disc": "discs, disc depth (Eq. 5)",
    "blended": "discs, blended depth",
    "round": "round Gaussians, blended depth",
}


def fit_image(frame: Frame, n: int, method: str, *, steps: int = STEPS, seed: int = 0) -> dict[str, float]:
    """Draw ``n`` pixels at random, seed a Gaussian at each, and optimise them on colour and depth of this one image.

    Args:
        frame: The image.
        n: Number of Gaussians, at most the number of pixels with depth and normal.
        method: "disc", "blended" or "round".
        steps: Optimisation steps.
        seed: Seed of the draw; with the same seed every method gets the same pixels.

    Returns:
        Name of a column of the table -> value. Depth errors are |rendered - measured depth| over the pixels with both;
        shares are of all measured pixels.
    """
    check_name("method", method, METHODS)
    settings = rtg_slam("replica")
    depth = "disc" if method == "disc" else "blended"
    discs = dataclasses.replace(
        settings.discs, opaque_alpha=OPAQUE_ALPHA, depth=depth
    )  # the paper's surfel, to 1 sigma
    context = SeedContext(frame, generator=torch.Generator().manual_seed(seed), discs=discs)
    usable = int((context.has_depth() & (context.normals() != 0).any(dim=-1)).sum())
    options = {"share": min(1.0, n / max(usable, 1))}
    seeds = apply_rule("rtg_slam", context, options)
    if method == "round":
        seeds = dataclasses.replace(seeds, scale_m=seeds.scale_m[:, :1].expand(-1, 3).clone())
    model = SurfelModel(sh_degree=0)
    model.append(seeds)
    optimiser = SurfelOptimiser(model, torch.ones(len(model), dtype=torch.bool), settings.window, discs)
    view = TrainingView.of(frame)
    for _ in range(steps):
        optimiser.step(view)
    optimiser.write_back()
    seen = view_surface(model.params, frame.camera, frame.T_WC, discs)
    known = frame.depth_m > 0
    both = known & (seen.depth_m > 0)
    error = (seen.depth_m - frame.depth_m)[both].abs()
    return {
        "mean depth error, cm": 100 * float(error.mean()),
        "median depth error, cm": 100 * float(error.median()),
        "pixels within 1 cm, %": 100 * float((error < 0.01).sum() / known.sum()),
        "pixels with depth, %": 100 * float(both.sum() / known.sum()),
        "PSNR, dB": psnr(seen.rgb, frame.rgb),
    }


def table_of(frames: Iterable[Frame], counts: Iterable[int] = COUNTS, *, steps: int = STEPS) -> str:
    """Fit every image with every number of Gaussians and every method.

    Returns:
        Means over the images as a Markdown table: one row per number of Gaussians and method.
    """
    frames, lines = list(frames), list[str]()
    cases = [(n, method) for n in counts for method in METHODS]
    with ProgressDisplay("fitting", total=len(cases), unit="row") as progress:
        for n, method in progress.over(cases):
            rows = [fit_image(frame, n, method, steps=steps) for frame in frames]
            if not lines:
                lines = [f"| Gaussians | | {' | '.join(rows[0])} |", "|---:|---|" + "---:|" * len(rows[0])]
            means = (f"{statistics.fmean(row[name] for row in rows):.2f}" for name in rows[0])
            lines.append(f"| {n:,} | {METHODS[method]} | {' | '.join(means)} |")
    return "\n".join(lines)


def main(data: str, folder: Path, views: int) -> int:
    """Fit ``views`` images spread over a sequence, print a table, and write it to ``folder``."""
    sequence = open_sequence(data, data=dataclasses.replace(rtg_slam("room").data, hold_out_every=0))
    picks = [round(i * (len(sequence) - 1) / max(views - 1, 1)) for i in range(views)]
    text = table_of(sequence[i] for i in picks)
    print(f"{views} images of {sequence.name}, each fitted alone\n\n{text}\n\nFiles in {folder}")
    (folder / "table.md").write_text(text + "\n", encoding="utf-8")
    return 0
