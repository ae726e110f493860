"""A solution of the first two parts of the examination, with the numbers of ``docs/teaching/exam_solution.md``.

``python -m gsfusion_nb.course.kit.exam_solution`` prints them.
"""

import dataclasses
import logging
from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from ...config import gsfusion
from ...evaluation import score_views
from ...geometry import backproject, pixel_grid, project, rays, se3
from ...mapping import GSFusion
from ...types import Frame
from ..gradient_check import compare_gradients
from .exam import FAULTS, frames_of

log = logging.getLogger(__name__)

APART = 3
"""The two views that are compared are this many frames apart."""


def disagreement_mm(frames: list[Frame]) -> float:
    """How far the depth of a frame is from that of a later one, median over pixels and pairs, millimetres."""
    medians = []
    for a, b in zip(frames[:-APART], frames[APART:], strict=True):
        grid = pixel_grid(a.camera)
        measured = a.depth_m > 0
        xyz_A = backproject(a.camera, grid[measured], a.depth_m[measured])
        xyz_B = se3.apply(se3.inverse(b.T_WC) @ a.T_WC, xyz_A)
        xyz_B = xyz_B[xyz_B[:, 2] > 0.1]
        u, v = project(b.camera, xyz_B).floor().long().unbind(-1)
        seen = (u >= 0) & (u < b.camera.width) & (v >= 0) & (v < b.camera.height)
        if int(seen.sum()) < 100:
            continue
        there = b.depth_m[v[seen], u[seen]]
        medians.append((xyz_B[seen, 2] - there)[there > 0].abs().median())
    return 1000 * float(torch.stack(medians).median()) if medians else float("inf")


def _each(change: Callable[[Frame], Frame]) -> Callable[[list[Frame]], list[Frame]]:
    return lambda frames: [change(frame) for frame in frames]


def _depth_along_z(frame: Frame) -> Frame:
    length = rays(frame.camera, pixel_grid(frame.camera)).norm(dim=-1)
    return dataclasses.replace(frame, depth_m=frame.depth_m / length)


def _next_pose(frames: list[Frame]) -> list[Frame]:
    return [dataclasses.replace(frame, T_WC=later.T_WC) for frame, later in pairwise(frames)]


REPAIRS: dict[str, Callable[[list[Frame]], list[Frame]]] = {
    "as it is": list,
    "range to z": _each(_depth_along_z),
    "pose of the next frame": _next_pose,
    "poses inverted": _each(lambda frame: dataclasses.replace(frame, T_WC=se3.inverse(frame.T_WC))),
    "depth / 0.9": _each(lambda frame: dataclasses.replace(frame, depth_m=frame.depth_m / 0.9)),
}


def held_out_psnr_db(frames: list[Frame]) -> tuple[float, int]:
    """Map three of four frames; PSNR of the others, and the number of Gaussians."""
    mapper = GSFusion(gsfusion("room", tsdf__voxel_size_m=0.02, sh_degree=0))
    for k, frame in enumerate(frames):
        if k % 4 != 2:
            mapper.step(frame)
    psnr_db = score_views(mapper.render, frames[2::4]).psnr
    assert isinstance(psnr_db, float)
    return psnr_db, len(mapper.gaussians)


def blended_depth(alpha: Tensor, z: Tensor) -> Tensor:
    """Mean depth of one pixel, each Gaussian with its weight. ``alpha``, ``z`` [K], nearest first."""
    w = alpha * torch.cat([torch.ones_like(alpha[:1]), (1 - alpha[:-1]).cumprod(0)])
    return (w * z).sum() / w.sum()


def blended_depth_vjp(alpha: Tensor, z: Tensor, v_depth: Tensor) -> tuple[Tensor, Tensor]:
    """From dL/dD to dL/dalpha [K] and dL/dz [K]."""
    T = torch.cat([torch.ones_like(alpha[:1]), (1 - alpha[:-1]).cumprod(0)])
    w = alpha * T
    v_w = v_depth * (z - (w * z).sum() / w.sum()) / w.sum()
    behind = (w * v_w).flip(0).cumsum(0).flip(0) - w * v_w
    return T * v_w - behind / (1 - alpha), v_depth * w / w.sum()


def print_faults() -> None:
    """The table of part A."""
    log.info("recording  %s", "  ".join(f"{name:>22}" for name in REPAIRS))
    for letter in FAULTS:
        frames = list(frames_of(letter))
        scores = {name: disagreement_mm(repair(frames)) for name, repair in REPAIRS.items()}
        log.info("%-9s  %s", letter, "  ".join(f"{score:19.1f} mm" for score in scores.values()))
    for letter in FAULTS:
        frames = list(frames_of(letter))
        scores = {name: disagreement_mm(repair(frames)) for name, repair in REPAIRS.items()}
        best = min(scores, key=lambda name: scores[name])
        before, n_before = held_out_psnr_db(frames)
        after, n_after = held_out_psnr_db(REPAIRS[best](frames))
        log.info(
            "%s: %s; held-out %.1f dB, %d Gaussians -> %.1f dB, %d", letter, best, before, n_before, after, n_after
        )


def print_gradient() -> None:
    """The check of part B."""
    g = torch.Generator().manual_seed(0)
    alpha, z = (torch.rand(4, dtype=torch.float64, generator=g) * 0.8 + 0.1 for _ in range(2))
    log.info(
        "%r", compare_gradients(blended_depth, lambda v, a, d: blended_depth_vjp(a, d, v), {"alpha": alpha, "z": z})
    )
    flat = blended_depth_vjp(alpha, torch.full_like(z, 2.0), torch.tensor(1.0, dtype=torch.float64))[0]
    log.info("all at one depth: dL/dalpha is at most %.1g", float(flat.abs().max()))


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    print_gradient()
    print_faults()
