"""Discs, their depth, and round Gaussians compared on one image (Peng et al. 2024, Fig. 7)."""

import dataclasses

import torch

from ..checks import check_name
from ..config import rtg_slam
from ..evaluation.image import psnr
from ..gaussians import SurfelModel
from ..optim import TrainingView
from ..render import view_surface
from ..render.constants import OPAQUE_ALPHA
from ..seeding import DiscInputs, SeedContext, apply_rule
from ..types import Frame
from .surfel_optimiser import SurfelOptimiser


def fit_image(
    frame: Frame,
    n: int,
    method: str,
    *,
    steps: int = 150,
    seed: int = 0,
) -> dict[str, float]:
    """Draw ``n`` pixels at random, seed a Gaussian at each, and optimise them on colour and depth
    of this one image (Peng et al. 2024, Fig. 7).

    Args:
        frame: The image.
        n: Number of Gaussians, at most the number of pixels with depth and normal.
        method: "disc": discs, disc depth (Eq. 5); "blended": discs, blended depth; "round": round
            Gaussians, blended depth.
        steps: Optimisation steps.
        seed: Seed of the draw; with the same seed every method gets the same pixels.

    Returns:
        Name of a column of the table -> value. Depth errors are |rendered - measured depth| over
        the pixels with both; shares are of all measured pixels.
    """
    check_name("method", method, ("disc", "blended", "round"))
    settings = rtg_slam(
        "replica", window__lr_xyz=1e-3, window__lr_sh_dc=5e-3, window__lr_log_scale=0.02
    )  # many steps
    depth = "disc" if method == "disc" else "blended"
    # the surfel to 1 sigma
    discs = dataclasses.replace(settings.discs, opaque_alpha=OPAQUE_ALPHA, depth=depth)
    generator = torch.Generator().manual_seed(seed)
    context = SeedContext(frame, generator=generator, system=DiscInputs(discs=discs))
    usable = int((context.has_depth() & (context.normals() != 0).any(dim=-1)).sum())
    options = {"share": min(1.0, n / max(usable, 1))}
    seeds = apply_rule("rtg_slam", context, options)
    if method == "round":
        seeds = dataclasses.replace(
            seeds,
            scale_m=seeds.scale_m[:, :1].expand(-1, 3).clone(),
        )
    model = SurfelModel(sh_degree=0)
    model.append(seeds)
    all_rows = torch.ones(len(model), dtype=torch.bool)
    optimiser = SurfelOptimiser(model, all_rows, settings.window, discs)
    view = TrainingView.of(frame)
    for _ in range(steps):
        optimiser.step(view)
    optimiser.write_back()
    surface = view_surface(model.params, frame.camera, frame.T_WC, discs)
    has_depth = frame.depth_m > 0
    both = has_depth & (surface.depth_m > 0)
    error = (surface.depth_m - frame.depth_m)[both].abs()
    return {
        "mean depth error, cm": 100 * float(error.mean()),
        "median depth error, cm": 100 * float(error.median()),
        "pixels within 1 cm, %": 100 * float((error < 0.01).sum() / has_depth.sum()),
        "pixels with depth, %": 100 * float(both.sum() / has_depth.sum()),
        "PSNR, dB": psnr(surface.rgb, frame.rgb),
    }
