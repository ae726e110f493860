"""The examination of ``docs/teaching/exam.md``: its recordings.

``python tools/exam.py OUT`` writes the recordings ``a.npz`` to ``e.npz``: one is right, the others
have one fault each. The letters say nothing about the fault; ``FAULTS`` is for the examiner.
"""

import argparse
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.files import atomic_file
from gsfusion_nb.geometry import pixel_grid, rays, se3
from gsfusion_nb.types import Camera, Frame

log = logging.getLogger(__name__)

FIRST = 40
N_FRAMES = 24
"""The part of the walk that the examination uses."""


def _range(frame: Frame, previous: Frame) -> Frame:
    length = rays(frame.camera, pixel_grid(frame.camera)).norm(dim=-1)
    return replace(frame, depth_m=frame.depth_m * length)


FAULTS: dict[str, tuple[str, Callable[[Frame, Frame], Frame]]] = {
    "a": ("depth is the length along the ray, not z", _range),
    "b": (
        "each frame has the pose of the frame before it",
        lambda frame, before: replace(frame, T_WC=before.T_WC),
    ),
    "c": ("none", lambda frame, before: frame),
    "d": (
        "poses go from the world to the camera",
        lambda frame, _: replace(frame, T_WC=se3.inverse(frame.T_WC)),
    ),
    "e": (
        "depth is a tenth too short",
        lambda frame, _: replace(frame, depth_m=frame.depth_m * 0.9),
    ),
}


def frames_of(letter: str) -> Iterator[Frame]:
    """The frames of a recording, with its fault; 160 x 120 pixels, poses and depth as a data set
    would give them."""
    room = RoomSequence(n_frames=120, width=160, height=120, trajectory="novel", seed=7)
    change = FAULTS[letter][1]
    for k in range(FIRST, FIRST + N_FRAMES):
        yield change(room[k], room[k - 1])


def write(letter: str, path: Path) -> None:
    """Write a recording: ``rgb`` [N, H, W, 3] uint8, ``depth_m`` [N, H, W], ``T_WC`` [N, 4, 4],
    ``intrinsics`` [4]."""
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
        rgb = arrays["rgb"]
        depth = arrays["depth_m"]
        poses = arrays["T_WC"]
        fx, fy, cx, cy = arrays["intrinsics"].tolist()
    camera = Camera(
        width=rgb.shape[2],
        height=rgb.shape[1],
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
    )
    return [
        Frame(
            index=k,
            timestamp_s=k / 2,
            rgb=torch.from_numpy(rgb[k]),
            depth_m=torch.from_numpy(depth[k]),
            camera=camera,
            T_WC=torch.from_numpy(poses[k]),
        )
        for k in range(len(rgb))
    ]


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Write the recordings of the examination.")
    parser.add_argument("out", type=Path, help="folder for the recordings")
    target = parser.parse_args(arguments).out
    for letter in FAULTS:
        write(letter, target / f"{letter}.npz")
        log.info("wrote %s", target / f"{letter}.npz")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main()
