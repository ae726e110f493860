"""``python tools/readme_picture.py`` draws the moving picture at the top of README.

A walk through the built-in room: left what the camera sees, right the map from above as it grows.
"""

from pathlib import Path

import torch
from PIL import Image

from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.viz import SplatViewer
from gsfusion_nb.viz.map_pictures import map_picture

TARGET = Path(__file__).resolve().parents[1] / "docs/images/room_grows.webp"
EVERY = 2
"""Frames of the walk between two pictures."""
SIZE = (360, 270)
MS = 160
"""How long a picture is shown."""
LAST_MS = 2500


def main() -> None:
    """Map the room, and write the pictures as one file."""
    config = gsfusion(
        "room",
        sh_degree=0,
        seeding__quadtree_threshold=0.02,
        tsdf__voxel_size_m=0.04,
        data__width=240,
        data__height=180,
        optim__global_iterations=6,
    )
    run = MappingRun(open_sequence("room", data=config.data, n_frames=60), GSFusion(config))
    photos, maps = [], []
    for k, frame in enumerate(run.sequence.mapping):
        run.mapper.step(frame)
        if k % EVERY == 0:
            photos.append(Image.fromarray(frame.rgb_u8.numpy()))
            maps.append(_copy(run.mapper.gaussians.params))
    for _ in run.optimise():
        pass
    photos.append(photos[-1])
    maps.append(_copy(run.mapper.gaussians.params))
    viewer = SplatViewer(run.mapper, width=SIZE[0], height=SIZE[1]).look_from("above")
    pictures = [_pair(photo, params, viewer) for photo, params in zip(photos, maps, strict=True)]
    durations = [MS] * (len(pictures) - 1) + [LAST_MS]
    pictures[0].save(
        TARGET,
        save_all=True,
        append_images=pictures[1:],
        duration=durations,
        loop=0,
        quality=70,
        method=6,
    )


def _copy(params):
    return type(params)(**{name: x.detach().clone() for name, x in vars(params).items()})


def _pair(photo: Image.Image, params, viewer: SplatViewer) -> Image.Image:
    """A photograph and the map from above, without what is nearer than the cut."""
    T_WC = viewer.T_WC
    depth_m = (params.xyz_W - T_WC[:3, 3]) @ T_WC[:3, 2]
    rows = params[depth_m > viewer.cut_m]
    drawn = map_picture(rows, viewer.camera, T_WC, background=torch.zeros(3))
    picture = Image.new("RGB", (2 * SIZE[0], SIZE[1]))
    picture.paste(photo.resize(SIZE, Image.Resampling.LANCZOS), (0, 0))
    picture.paste(Image.fromarray(drawn), (SIZE[0], 0))
    return picture


if __name__ == "__main__":
    main()
