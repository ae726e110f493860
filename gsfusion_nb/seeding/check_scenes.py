"""Small built-in scenes on which a seeding rule is checked."""

import dataclasses
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import SeedingConfig, TsdfConfig
from ..gaussians import GaussianModel
from ..geometry import pixel_grid, rays, se3
from ..tsdf import TsdfVolume, integrate
from ..types import Camera, Frame, Seeds
from .context import SeedContext

_TSDF = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)

_SPHERE = ((0.1, 0.05, 1.3), 0.3)

_WALL = ((0.2, 0.0, -1.0), -1.9)
"""Normal (not of unit length) and offset: points with normal . p = offset, a slanted wall near z =
2."""


def check_contexts() -> dict[str, SeedContext]:
    """Small scenes by name: a textured slanted wall with a sphere before it, seen from a tilted
    camera.

    "new": no Gaussians yet; "half seen": the left half was observed before and has Gaussians;
    "holes": depth missing in stripes; "dark": no depth at all; "odd": 7 x 5 pixels; "tiny": one
    pixel; "real map": a TSDF volume and a Gaussian map made from the first view, seen from a place
    beside it.
    """
    new = _scene_frame(61, 47)
    stripes = new.depth_m * (torch.arange(61) % 3 > 0)
    frames = {
        "new": new,
        "half seen": new,
        "holes": dataclasses.replace(new, depth_m=stripes),
        "dark": dataclasses.replace(new, depth_m=torch.zeros_like(new.depth_m)),
        "odd": _scene_frame(7, 5),
        "tiny": _scene_frame(1, 1),
    }
    # an absolute variance threshold would leave images this small in one piece
    config = SeedingConfig(quadtree_contrast="std", quadtree_threshold=0.05)
    contexts = {}
    for name, frame in frames.items():
        volume = TsdfVolume(_TSDF)
        gaussians = GaussianModel(sh_degree=0)
        integrate(volume, frame)
        contexts[name] = ctx = SeedContext(frame, volume, gaussians, config=config)
        if name == "half seen":
            left_half = dataclasses.replace(frame, depth_m=frame.depth_m * (torch.arange(61) < 30))
            for _ in range(2):
                integrate(volume, left_half)
            places = pixel_grid(frame.camera)[::8, :30:8].reshape(-1, 2)
            gaussians.append(ctx.seeds_at(places, 2.0, opacity=0.9), frame.index)
    contexts["real map"] = _real_map(new, config)
    return contexts


def _real_map(frame: Frame, config: SeedingConfig) -> SeedContext:
    """Maps as a mapper has them: one frame fused and seeded, then a second one from 15 cm beside it
    fused."""
    volume = TsdfVolume(_TSDF)
    gaussians = GaussianModel(sh_degree=0)
    integrate(volume, frame)
    gaussians.append(SeedContext(frame, volume, config=config).cells(), frame.index)
    neighbour = _scene_frame(61, 47, shift_m=0.15)
    integrate(volume, neighbour)
    return SeedContext(neighbour, volume, gaussians, config=config)


class Walk:
    """A camera that moves sideways through the scene, and maps that grow as in a mapper, without
    optimisation.

    So that the Gaussians are not all round and equal, their sizes, directions and opacities are
    disturbed. Some are large, nearly transparent, or both, so that a rule's edits of these meet.
    """

    n_frames = 3

    def __init__(self):
        self._volume = TsdfVolume(_TSDF)
        self.gaussians = GaussianModel(sh_degree=1)
        self._frames: list[Frame] = []

    def context(self, number: int, memory: dict[str, Any]) -> SeedContext:
        """What a rule sees of the next frame; ``memory`` is what it kept so far. The frame is in
        the volume."""
        frame = dataclasses.replace(_scene_frame(48, 36, shift_m=0.2 * number), index=number)
        integrate(self._volume, frame)
        self._frames.append(frame)
        past = tuple(f.T_WC for f in self._frames[:-1])
        config = SeedingConfig(quadtree_contrast="std", quadtree_threshold=0.05)
        return SeedContext(
            frame,
            self._volume,
            self.gaussians,
            config=config,
            memory=memory,
            past_T_WC=past,
            starts_submap=not number,
        )

    def grow(self, seeds: Seeds) -> None:
        """Add seeds to the map."""
        n_old = len(self.gaussians)
        self.gaussians.append(seeds, self._frames[-1].index)
        params = self.gaussians.params
        n = len(self.gaussians) - n_old
        g = torch.Generator().manual_seed(n_old)
        for column, size in (
            (params.log_scale, 0.3),
            (params.quat, 0.2),
            (params.opacity_logit, 1.0),
        ):
            column[n_old:] += size * torch.randn(n, *column.shape[1:], generator=g)
        params.log_scale[n_old::5] += (
            2.5  # some large ones, and some nearly transparent ones, of which some are both
        )
        params.opacity_logit[n_old::3] = -6.0
        self.gaussians.clock.advance(self.gaussians.clock.count + 5)


def _scene_frame(width: int, height: int, shift_m: float = 0.0) -> Frame:
    """The scene by exact ray casting. The wall has four plain quarters and the sphere stripes:
    cells of several sizes.

    With ``shift_m`` the camera is that far to the right of the scene's usual camera.
    """
    camera = Camera(
        width=width,
        height=height,
        fx=float(width),
        fy=float(width),
        cx=width / 2,
        cy=height / 2,
    )
    eye = torch.tensor([shift_m, 0.0, 0.0])
    depth_m, rgb = _scene_images(camera, eye)
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.2, 2.0, -0.3]))
    T_WC[:3, 3] += T_WC[:3, :3] @ eye
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=depth_m,
        camera=camera,
        T_WC=T_WC,
    )


def _scene_images(
    camera: Camera, eye: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W 3"]]:
    """Depth, metres, and colour of the scene, seen from ``eye`` in the scene's frame."""
    ray = rays(camera, pixel_grid(camera))
    wall = ray.new_tensor(_WALL[0])
    z_wall = (_WALL[1] - wall @ eye) / (ray @ wall)
    centre = ray.new_tensor(_SPHERE[0]) - eye
    radius = _SPHERE[1]
    a = (ray * ray).sum(-1)
    b = ray @ centre
    c = centre @ centre - radius**2
    root = b * b - a * c
    z_sphere = torch.where(
        root > 0,
        (b - root.clamp_min(0).sqrt()) / a,
        torch.inf,
    )
    depth_m = torch.minimum(z_wall, z_sphere)
    point = ray * depth_m[..., None] + eye
    checks = ((point[..., :2] > 0).sum(-1) % 2)[..., None]
    stripes = 0.5 + 0.5 * torch.sin(point * torch.tensor([40.0, 3.0, 11.0]))
    return depth_m, torch.where(
        (z_sphere < z_wall)[..., None], stripes, 0.25 + 0.5 * checks.expand_as(stripes)
    )
