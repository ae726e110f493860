"""The scenes of ``check_rule``: defined by formulas, and one with real maps."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import SeedingConfig, TsdfConfig
from ..gaussians import GaussianModel
from ..geometry import depth_to_normals, pixel_grid, rays, se3
from ..tsdf import RaycastOutput, TsdfVolume, integrate
from ..types import Camera, Frame, GaussianParams, Seeds
from .context import SeedContext

_TSDF = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)
_SPHERE = ((0.1, 0.05, 1.3), 0.3)
_WALL = ((0.2, 0.0, -1.0), -1.9)
"""Normal (not of unit length) and offset: points with normal . p = offset, a slanted wall near z = 2."""


def check_contexts() -> dict[str, SeedContext]:
    """Small scenes by name: a textured slanted wall with a sphere before it, seen from a tilted camera.

    "new": nothing mapped yet; "half seen": the left half was observed before and has Gaussians; "holes": depth missing
    in stripes; "dark": no depth at all; "odd": 7 x 5 pixels; "tiny": one pixel; "real map": a TSDF volume and a
    Gaussian map made from the first view, seen from a place beside it.
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
        seen_left = name == "half seen"
        volume = SceneVolume(frame.T_WC, seen_left)
        contexts[name] = SeedContext(frame, volume, _scene_map(frame, seen_left), config=config)
    contexts["real map"] = _real_map(new, config)
    return contexts


def _real_map(frame: Frame, config: SeedingConfig) -> SeedContext:
    """Maps as a mapper has them: one frame fused and seeded, then a second one from 15 cm beside it fused."""
    volume, gaussians = TsdfVolume(_TSDF), GaussianModel(sh_degree=0)
    integrate(volume, frame)
    gaussians.append(SeedContext(frame, volume, config=config).cells(), frame.index)
    beside = _scene_frame(61, 47, shift_m=0.15)
    integrate(volume, beside)
    return SeedContext(beside, volume, gaussians, config=config)


class Walk:
    """A camera that moves sideways through the scene, and maps that grow as in a mapper, without optimisation.

    So that the Gaussians are not all round and equal, their sizes, directions and opacities are disturbed a little.
    """

    n_frames = 3

    def __init__(self):
        self._volume, self._gaussians = TsdfVolume(_TSDF), GaussianModel(sh_degree=1)
        self._frames: list[Frame] = []

    def context(self, number: int, memory: dict[str, Any]) -> SeedContext:
        """What a rule sees of the next frame; ``memory`` is what it kept so far. The frame is in the volume."""
        frame = dataclasses.replace(_scene_frame(48, 36, shift_m=0.2 * number), index=number)
        integrate(self._volume, frame)
        self._frames.append(frame)
        past = tuple(f.T_WC for f in self._frames[:-1])
        config = SeedingConfig(quadtree_contrast="std", quadtree_threshold=0.05)
        return SeedContext(
            frame, self._volume, self._gaussians, config=config, memory=memory, past_T_WC=past, starts_submap=not number
        )

    def grow(self, seeds: Seeds) -> None:
        """Add seeds to the map."""
        before = len(self._gaussians)
        self._gaussians.append(seeds, self._frames[-1].index)
        params, n, g = self._gaussians.params, len(self._gaussians) - before, torch.Generator().manual_seed(before)
        for column, size in ((params.log_scale, 0.3), (params.quat, 0.2), (params.opacity_logit, 1.0)):
            column[before:] += size * torch.randn(n, *column.shape[1:], generator=g)
        self._gaussians.step_count += 5


class SceneVolume:
    """The scene as a TSDF volume that needs no integration: distances come from the formula.

    Voxels in the truncation band have weight 1, or 3 in the left half of the view if that ``seen_left``.
    """

    def __init__(self, T_WC: Float[Tensor, "4 4"], seen_left: bool):
        self.config = _TSDF
        self._T_CW = se3.inverse(T_WC)
        self._seen_left = seen_left

    def sample_nearest(self, xyz_W: Float[Tensor, "N 3"]) -> Any:
        """``D``, ``W`` and ``rgb`` at the centres of the voxels that contain the points."""
        size = self.config.voxel_size_m
        centre = ((xyz_W / size).floor() + 0.5) * size
        xyz_C = se3.apply(self._T_CW, centre)
        D = (_distance(xyz_C) / self.config.truncation_m).clamp(-1.0, 1.0)
        W = torch.ones_like(D)
        if self._seen_left:
            W[xyz_C[:, 0] < 0] = 3.0
        W[D.abs() >= 1] = 0.0
        return SimpleNamespace(D=D, W=W, rgb=torch.full_like(xyz_C, 0.5))

    def raycast(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RaycastOutput:
        """The surface as a camera at the pose of the scene's sees it."""
        depth_m, rgb = _scene_images(camera, torch.zeros(3))
        normal_W = se3.rotate(T_WC, depth_to_normals(camera, depth_m))
        return RaycastOutput(depth_m=depth_m, normal_W=normal_W, rgb=rgb)


def _distance(xyz_C: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    centre, radius = xyz_C.new_tensor(_SPHERE[0]), _SPHERE[1]
    normal = xyz_C.new_tensor(_WALL[0])
    wall = (xyz_C @ normal - _WALL[1]) / normal.norm()
    return torch.minimum(wall, (xyz_C - centre).norm(dim=-1) - radius)


def _scene_frame(width: int, height: int, shift_m: float = 0.0) -> Frame:
    """The scene by exact ray casting. The wall has four plain quarters and the sphere stripes: cells of several sizes.

    With ``shift_m`` the camera is that far to the right of the scene's usual camera.
    """
    camera = Camera(width=width, height=height, fx=float(width), fy=float(width), cx=width / 2, cy=height / 2)
    eye = torch.tensor([shift_m, 0.0, 0.0])
    depth_m, rgb = _scene_images(camera, eye)
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.2, 2.0, -0.3]))
    T_WC[:3, 3] += T_WC[:3, :3] @ eye
    return Frame(index=0, timestamp_s=0.0, rgb=rgb, depth_m=depth_m, camera=camera, T_WC=T_WC)


def _scene_images(camera: Camera, eye: Float[Tensor, " 3"]) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W 3"]]:
    """Depth, metres, and colour of the scene, seen from ``eye`` in the scene's frame."""
    ray = rays(camera, pixel_grid(camera))
    wall = ray.new_tensor(_WALL[0])
    z_wall = (_WALL[1] - wall @ eye) / (ray @ wall)
    centre, radius = ray.new_tensor(_SPHERE[0]) - eye, _SPHERE[1]
    a, b, c = (ray * ray).sum(-1), ray @ centre, centre @ centre - radius**2
    root = b * b - a * c
    z_sphere = torch.where(root > 0, (b - root.clamp_min(0).sqrt()) / a, torch.inf)
    depth_m = torch.minimum(z_wall, z_sphere)
    point = ray * depth_m[..., None] + eye
    checks = ((point[..., :2] > 0).sum(-1) % 2)[..., None]
    stripes = 0.5 + 0.5 * torch.sin(point * torch.tensor([40.0, 3.0, 11.0]))
    return depth_m, torch.where((z_sphere < z_wall)[..., None], stripes, 0.25 + 0.5 * checks.expand_as(stripes))


def _scene_map(frame: Frame, seen_left: bool) -> Any:
    """Gaussians on the left part of the scene, or none."""
    W = frame.camera.width
    uv = pixel_grid(frame.camera)[::8, : W // 2 : 8].reshape(-1, 2) if seen_left else torch.zeros(0, 2)
    z = frame.depth_m[uv[:, 1].long(), uv[:, 0].long()]
    xyz_W = se3.apply(frame.T_WC, rays(frame.camera, uv) * z[:, None])
    n = len(uv)
    quat = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    params = GaussianParams(
        xyz_W=xyz_W,
        log_scale=torch.full((n, 3), -3.0),
        quat=quat,
        opacity_logit=torch.full((n,), 2.0),
        sh=torch.zeros(n, 1, 3),
    )
    return SimpleNamespace(params=params)
