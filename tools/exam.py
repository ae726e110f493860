"""The examination of ``docs/teaching/exam.md``: its recordings, and a solution of the first two parts.

``python tools/exam.py OUT`` writes the recordings ``a.npz`` to ``e.npz``: one is right, the others have one fault each.
The letters say nothing about the fault; ``FAULTS`` is for the examiner. ``python tools/exam.py --solution`` prints the
numbers of ``docs/teaching/exam_solution.md``.
"""

import argparse
import dataclasses
import logging
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsfusion_nb.config import gsfusion
from gsfusion_nb.course.gradient_check import compare_gradients
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.evaluation import score_views
from gsfusion_nb.files import atomic_file
from gsfusion_nb.geometry import backproject, pixel_grid, project, rays, se3
from gsfusion_nb.mapping import GSFusion
from gsfusion_nb.types import Camera, Frame

log = logging.getLogger(__name__)

FIRST, N_FRAMES = 40, 24
"""The part of the walk that the examination uses."""


def _inverted(frame: Frame, before: Frame) -> Frame:
    return dataclasses.replace(frame, T_WC=se3.inverse(frame.T_WC))


def _range(frame: Frame, before: Frame) -> Frame:
    length = rays(frame.camera, pixel_grid(frame.camera)).norm(dim=-1)
    return dataclasses.replace(frame, depth_m=frame.depth_m * length)


def _tenth_short(frame: Frame, before: Frame) -> Frame:
    return dataclasses.replace(frame, depth_m=frame.depth_m * 0.9)


def _late_pose(frame: Frame, before: Frame) -> Frame:
    return dataclasses.replace(frame, T_WC=before.T_WC)


def _right(frame: Frame, before: Frame) -> Frame:
    return frame


FAULTS: dict[str, tuple[str, Callable[[Frame, Frame], Frame]]] = {
    "a": ("depth is the length along the ray, not z", _range),
    "b": ("each frame has the pose of the frame before it", _late_pose),
    "c": ("none", _right),
    "d": ("poses go from the world to the camera", _inverted),
    "e": ("depth is a tenth too short", _tenth_short),
}


def frames_of(letter: str, *, n_frames: int = N_FRAMES) -> Iterator[Frame]:
    """The frames of a recording, with its fault; 160 x 120 pixels, poses and depth as a data set would give them."""
    room = RoomSequence(n_frames=120, width=160, height=120, trajectory="novel", seed=7)
    change = FAULTS[letter][1]
    for k in range(FIRST, FIRST + n_frames):
        yield change(room[k], room[k - 1])


def write(letter: str, path: Path) -> None:
    """Write a recording: ``rgb`` [N, H, W, 3] uint8, ``depth_m`` [N, H, W], ``T_WC`` [N, 4, 4], ``intrinsics`` [4]."""
    frames = list(frames_of(letter))
    camera = frames[0].camera
    with atomic_file(path) as temporary:
        np.savez_compressed(
            temporary,
            rgb=torch.stack([frame.rgb_u8 for frame in frames]).numpy(),
            depth_m=torch.stack([frame.depth_m for frame in frames]).numpy(),
            T_WC=torch.stack([frame.T_WC for frame in frames]).numpy(),
            intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        )


def read(path: Path) -> list[Frame]:
    """The frames of a file that ``write`` wrote."""
    with np.load(path, allow_pickle=False) as arrays:
        rgb, depth, poses = arrays["rgb"], arrays["depth_m"], arrays["T_WC"]
        fx, fy, cx, cy = arrays["intrinsics"].tolist()
    camera = Camera(width=rgb.shape[2], height=rgb.shape[1], fx=fx, fy=fy, cx=cx, cy=cy)
    return [
        Frame(index=k, timestamp_s=k / 2, rgb=torch.from_numpy(rgb[k]), depth_m=torch.from_numpy(depth[k]),
              camera=camera, T_WC=torch.from_numpy(poses[k]))
        for k in range(len(rgb))
    ]  # fmt: skip


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


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Write the recordings of the examination, or print its solution.")
    parser.add_argument("out", type=Path, nargs="?", help="folder for the recordings")
    parser.add_argument("--solution", action="store_true", help="print the numbers of parts A and B")
    options = parser.parse_args(arguments)
    if options.out is None and not options.solution:
        parser.error("name a folder for the recordings, or ask for --solution")
    if options.out is not None:
        for letter in FAULTS:
            write(letter, options.out / f"{letter}.npz")
            log.info("wrote %s", options.out / f"{letter}.npz")
    if options.solution:
        print_gradient()
        print_faults()


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main()
