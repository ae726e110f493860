"""Fetch sequences of Augmented ICL-NUIM (Handa et al. 2014, Choi et al. 2015) from Open3D's mirror.

    python data_scripts/icl_nuim.py livingroom1-clean --out data

Synthetic, with true poses and a true surface; the only data set here with public checksums. Written
in the plain layout: rgb/, depth/, poses.txt, intrinsics.json; groundtruth.ply is the true surface
as a point cloud.
"""

import json
import re
import sys
from pathlib import Path

import torch

from gsfusion_nb.data import SequenceError
from gsfusion_nb.data.recorded.files import images_in
from gsfusion_nb.data.recorded.poses import image_number, write_pose_lines
from gsfusion_nb.recordings import fetch
from gsfusion_nb.recordings.convert.formats.open3d_log import read_trajectory_file
from gsfusion_nb.recordings.fetch import Item, Plan, SequenceOnDisk

HOST = "https://github.com/isl-org/open3d_downloads/releases/download/augmented-icl-nuim"
MD5 = {
    "livingroom.ply.zip": "841f32ff6294bb52d5f9574834e0925e",
    "livingroom1-color.zip": "c23481094ca3859b204d2fcbb4e435a4",
    "livingroom1-depth-clean.zip": "6867ddac0e7aafe828a218b385f61985",
    "livingroom1-depth-simulated.zip": "2fec03a29258a29b9ffedde88fddd676",
    "livingroom1-traj.txt": "601ac4b51aba2455a90aed8aa1158c6a",
    "livingroom2-color.zip": "34792f7aa35b6c8b62e394e9372b95d7",
    "livingroom2-depth-clean.zip": "569c7ba065c3a84de32b0d0844699f43",
    "livingroom2-depth-simulated.zip": "cbb4a36b8488448d79ec93c202c0c90e",
    "livingroom2-traj.txt": "193961c018f4c2a753458d5231544036",
    "office.ply.zip": "ba3640bba38f19c8f2d5e86e045eeae5",
    "office1-color.zip": "6a58750880e83ac5948e0f28de294c04",
    "office1-depth-clean.zip": "0a952d68eb76e84fad63e362a59f82cd",
    "office1-depth-simulated.zip": "7c7e479191d35c2ad1f8ac1c227f4f8d",
    "office1-traj.txt": "3fac752ab38a4e8a96d1b5afa535f9f7",
    "office2-color.zip": "487cdfacffc8fc8247a5b21e860a3794",
    "office2-depth-clean.zip": "386203a7a5dae21db6d8430ae36dcc8b",
    "office2-depth-simulated.zip": "13f1c5b7c4f44524fa91f7ba87e44bb5",
    "office2-traj.txt": "698f2f09da7d2ed3fcb604889e6f8479",
}
"""Published in Open3D's data module."""
SEQUENCES = [
    f"{name}-{depth}"
    for name in ("livingroom1", "livingroom2", "office1", "office2")
    for depth in ("clean", "simulated")
]
"""With exact depth, or depth with sensor errors."""
COLOUR_BYTES = 400_000_000
DEPTH_BYTES = 500_000_000
CLOUD_BYTES = 100_000_000
POSES_BYTES = 600_000
"""Estimated."""
PRIMESENSE = {
    "width": 640,
    "height": 480,
    "fx": 525.0,
    "fy": 525.0,
    "cx": 319.5,
    "cy": 239.5,
    "pixel_centre": 0.0,
}


def to_plain_layout(folder: Path) -> None:
    """Write poses and camera in the plain layout. Line k of the poses is of the k-th number of the
    images' names."""
    poses, _ = read_trajectory_file(folder / "trajectory.log")
    numbers = [image_number(image) or 0 for image in images_in(folder / "rgb")]
    frames = [number - numbers[0] for number in numbers]
    lacking = sorted(set(frames) - set(poses))
    if lacking:
        raise SequenceError(
            f"{folder / 'trajectory.log'} lacks the pose of frame {lacking[0]}; expected all from "
            "0 on"
        )
    write_pose_lines(folder / "poses.txt", torch.stack([poses[i] for i in frames]))
    values = PRIMESENSE | {"depth_scale": 1000.0}
    (folder / "intrinsics.json").write_text(json.dumps(values) + "\n", encoding="utf-8")


def by_number(kind: str, suffix: str):
    """Choose the images of an archive, in any of its folders."""

    def choose(path: str) -> str | None:
        match = re.fullmatch(rf"(?:.*/)?(\d+)\.{suffix}", path)
        return f"{kind}/{match[1]}.{suffix}" if match else None

    return choose


def plan(name: str) -> Plan:
    """Files of one sequence."""
    sequence, depth = name.split("-")
    room = sequence.rstrip("12")
    kinds = {
        f"{sequence}-color.zip": {"stated_bytes": COLOUR_BYTES, "choose": by_number("rgb", "jpg")},
        f"{sequence}-depth-{depth}.zip": {
            "stated_bytes": DEPTH_BYTES,
            "choose": by_number("depth", "png"),
        },
        f"{sequence}-traj.txt": {"stated_bytes": POSES_BYTES, "save_as": "trajectory.log"},
        f"{room}.ply.zip": {
            "stated_bytes": CLOUD_BYTES,
            "choose": lambda path: "groundtruth.ply" if path.endswith(".ply") else None,
        },
    }
    return Plan(
        folder=f"icl_nuim/{name}",
        title=f"Augmented ICL-NUIM, {sequence}, "
        f"{'noise-free' if depth == 'clean' else 'simulated'} depth",
        licence="Creative Commons Attribution 3.0 (CC BY 3.0), as ICL-NUIM.",
        cite="Handa, Whelan, McDonald, Davison: A Benchmark for RGB-D VO, 3D Reconstruction and "
        "SLAM, 2014; Choi, Zhou, Koltun: Robust Reconstruction of Indoor Scenes, 2015.",
        items=[
            Item(url=f"{HOST}/{file}", checksum=f"md5:{MD5[file]}", **kind)
            for file, kind in kinds.items()
        ],
        unpacked_bytes=COLOUR_BYTES + DEPTH_BYTES + 3 * CLOUD_BYTES,
        sequences=lambda root: [SequenceOnDisk(preset="replica" if depth == "clean" else "tum")],
        convert=to_plain_layout,
    )


def main(arguments: list[str] | None = None) -> int:
    """Fetch what the command line names."""
    return fetch.run(__doc__ or "", plan, SEQUENCES, arguments)


if __name__ == "__main__":
    sys.exit(main())
