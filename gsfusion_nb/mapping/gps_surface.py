"""A map of GPS-SLAM as a camera sees it, and as plain Gaussians for programs that know no surface
below them.

The surface becomes opaque discs, one in each voxel that it crosses. A Gaussian of weight w over the
surface's colour C_s gives (C_s + w c) / (1 + w), and one of opacity a in front of a disc gives a c
+ (1 - a) C_s: the same for

    a = w / (1 + w)                                                                             (1)

so its opacity o becomes o / (1 + o). This is exact where one Gaussian covers a pixel, and only at
its centre: away from it (1) falls off more slowly than a Gaussian, and of several, sorted ones take
light from each other. A Gaussian is blended with the surface also when it lies behind it; here it
would be hidden, so each is moved in front of the discs.

Discs of one colour are coarser than the TSDF, which interpolates between voxels. So colours,
opacities and sizes are then fitted (``fit_to_pictures``) to pictures of the map itself.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..config import BaseConfig, OptimConfig
from ..export.tsdf_file import TSDF, as_stored, read_tsdf
from ..gaussians import GaussianModel
from ..geometry import quaternion
from ..geometry.spherical_harmonics import rgb_to_sh_dc
from ..geometry.voxel_keys import voxel_keys
from ..optim import adam_step, l1_mse_vjp
from ..render import SurfacePicture, render_forward, render_over_base, render_vjp, surface_picture
from ..render.constants import NEAR_PLANE_M
from ..render.near_plane import near_plane_m
from ..tsdf import TsdfVolume, extract_mesh, raycast
from ..tsdf.cells import cell_corners, corner_gradients
from ..types import Camera, GaussianParams, Mesh, RenderOutput

DISC_VOXELS = 0.4
"""Standard deviation of a disc, voxels: larger hides gaps between discs and blurs colours."""
THIN_VOXELS = 0.05
"""Standard deviation of a disc across the surface, voxels."""
IN_FRONT_VOXELS = 1.0
"""How far in front of the surface the Gaussians are, voxels: less, and discs beside them cover them
in flat views."""
WIDER = 1.1
"""Factor on the size of the Gaussians, for the slower fall-off of (1)."""
CAMERA = Camera(
    width=320,
    height=240,
    fx=200.0,
    fy=200.0,
    cx=160.0,
    cy=120.0,
)
"""Of the pictures that discs are fitted to, wide, so that it sees at least what the recording's
camera saw."""
_RATES = OptimConfig(
    lr_xyz=0.0,
    lr_quat=0.0,
    lr_sh_dc=0.02,
    lr_sh_rest=0.001,
    lr_log_scale=0.01,
    lr_opacity_logit=0.05,
)


def plain_gaussians(
    volume: TsdfVolume,
    params: GaussianParams,
    discs: GaussianParams | None = None,
    mesh: Mesh | None = None,
) -> GaussianParams:
    """Surface and Gaussians as Gaussians for a sorted renderer: first the Gaussians, in their
    order, then the discs.

    Holes of the surface stay holes.

    Args:
        volume: Of the map.
        params: Its Gaussians.
        discs: Those of an earlier surface, to save the time of making new ones.
        mesh: The surface, if it is known; otherwise it is extracted from the volume.

    Differentiable: no.
    """
    if discs is None:
        mesh = extract_mesh(volume) if mesh is None else mesh
        discs = surface_discs(mesh, volume.config.voxel_size_m, params.sh.shape[1])
    raised = in_front(volume, params)
    return GaussianParams(
        **{name: torch.cat([rows, getattr(discs, name)]) for name, rows in vars(raised).items()}
    )


def fit_to_pictures(
    gaussians: GaussianParams,
    draw: Callable[[Camera, Tensor], RenderOutput],
    poses: Sequence[Float[Tensor, "4 4"]],
    steps: int,
) -> GaussianParams:
    """The Gaussians after gradient steps on pictures of the map; places and rotations stay.

    Args:
        gaussians: From ``plain_gaussians``.
        draw: Renders the map.
        poses: Camera-to-world poses to see it from, at least one: those of the recording.
        steps: Number of steps, each on one of the poses, in a random order that is always the same.
    """
    degree = math.isqrt(gaussians.sh.shape[1]) - 1
    model = GaussianModel(degree, device=gaussians.xyz_W.device)
    model.extend(gaussians)
    generator = torch.Generator().manual_seed(0)
    turns = list[int]()
    for _ in range(steps):
        turns = turns or torch.randperm(len(poses), generator=generator).tolist()
        T_WC = poses[turns.pop()].to(gaussians.xyz_W)
        target = draw(CAMERA, T_WC).rgb.clamp(0, 1)
        output, record = render_forward(model.params, CAMERA, T_WC)
        adam_step(model, render_vjp(record, l1_mse_vjp(output.rgb, target).v_rgb), _RATES)
    return model.params


def surface_discs(mesh: Mesh, voxel_size_m: float, coefficients: int = 1) -> GaussianParams:
    """An opaque disc in each voxel that holds vertices of the mesh, at their mean place and in
    their mean colour."""
    xyz = mesh.vertices_W
    _, voxel = voxel_keys((xyz / voxel_size_m).floor().long()).unique(return_inverse=True)
    n = int(voxel.max()) + 1 if len(voxel) else 0
    mean = _means(
        torch.cat([xyz, mesh.rgb, vertex_normals(mesh)], dim=1),
        voxel,
        n,
    )
    centre = mean[:, :3]
    rgb = mean[:, 3:6]
    normal = torch.nn.functional.normalize(mean[:, 6:], dim=1)
    sh = xyz.new_zeros(n, coefficients, 3)
    sh[:, 0] = rgb_to_sh_dc(rgb)
    size_m = voxel_size_m * torch.tensor([DISC_VOXELS, DISC_VOXELS, THIN_VOXELS]).to(xyz)
    return GaussianParams(
        xyz_W=centre,
        log_scale=size_m.log().expand(n, 3).clone(),
        quat=quaternion.shortest_arc(normal.new_tensor([0.0, 0.0, 1.0]).expand_as(normal), normal),
        opacity_logit=xyz.new_full((n,), math.log(0.99 / 0.01)),
        sh=sh,
    )


def in_front(volume: TsdfVolume, params: GaussianParams) -> GaussianParams:
    """The Gaussians with the opacities of (1), moved along the surface's normal until they are in
    front of it."""
    voxel_m = volume.config.voxel_size_m
    truncation_m = volume.config.truncation_m
    D, is_known = volume.interpolate(params.xyz_W)
    at, f = cell_corners(volume, params.xyz_W[is_known])
    gradient = (volume.D.view(-1)[at][..., None] * corner_gradients(f)).sum(1)
    lacking_m = (IN_FRONT_VOXELS * voxel_m - D[is_known] * truncation_m).clamp(min=0)
    xyz = params.xyz_W.clone()
    xyz[is_known] += lacking_m[:, None] * torch.nn.functional.normalize(gradient, dim=1)
    o = params.opacity_logit.sigmoid()
    wide = params.log_scale + math.log(WIDER)
    return dataclasses.replace(
        params,
        xyz_W=xyz,
        opacity_logit=(o / (1 + o)).logit(),
        log_scale=wide,
    )


def vertex_normals(mesh: Mesh) -> Float[Tensor, "V 3"]:
    """Sum of the normals of the triangles around each vertex, weighted by their areas; not of unit
    length."""
    a, b, c = mesh.vertices_W[mesh.faces.long()].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(mesh.vertices_W)
    for corner in mesh.faces.long().unbind(1):
        sums.index_add_(0, corner, normal)
    return sums


def _means(
    rows: Float[Tensor, "V C"],
    group: Int[Tensor, " V"],
    n: int,
) -> Float[Tensor, "N C"]:
    total = rows.new_zeros(n, rows.shape[1]).index_add_(0, group, rows)
    return total / torch.bincount(group, minlength=n).clamp_min(1)[:, None]


Look = Callable[[Camera, Float[Tensor, "4 4"]], tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]]
"""Colour and depth of a surface that a camera sees, one ray for each pixel."""
KEPT_LOOKS_BYTES = 1 << 28
"""Largest memory of what was seen of a surface and is kept for the next score: 218 pictures of
320x240."""


class StoredLooks:
    """What cameras see of a volume as its file holds it, kept while the volume is the same.

    A run scores the same views before and after its passes, which do not change the surface: it is
    rounded, and rays are cast, once.
    """

    def __init__(self) -> None:
        self._state: tuple[TsdfVolume | None, int] = (None, 0)
        self._pictures: dict[tuple[Camera, bytes], tuple[Tensor, Tensor]] = {}
        self.n_bytes = 0
        """Of what is kept."""

    def of(self, volume: TsdfVolume, n_frames: int) -> Look:
        """Looks at the volume as it is now.

        Args:
            volume: Of the map.
            n_frames: Number of frames fused into it, which says whether it has changed.
        """
        if self._state[0] is not volume or self._state[1] != n_frames:
            self.forget()
            self._state = volume, n_frames
        volume_in_file = functools.cache(lambda: as_stored(volume))
        pictures = self._pictures

        def look(camera: Camera, T_WC: Float[Tensor, "4 4"]) -> tuple[Tensor, Tensor]:
            place = camera, T_WC.detach().cpu().contiguous().numpy().tobytes()
            if place in pictures:
                return pictures[place]
            surface = raycast(volume_in_file(), camera, T_WC.to(volume.device))
            n_bytes = surface.rgb.nbytes + surface.depth_m.nbytes
            if self.n_bytes + n_bytes <= KEPT_LOOKS_BYTES:
                pictures[place] = surface.rgb, surface.depth_m
                self.n_bytes += n_bytes
            return surface.rgb, surface.depth_m

        return look

    def forget(self) -> None:
        """Keep nothing."""
        self._state = (None, 0)
        self._pictures = {}
        self.n_bytes = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class OverSurface:
    """A surface and the Gaussians that correct its picture."""

    volume: TsdfVolume
    params: GaussianParams
    config: BaseConfig
    look: Look | None = None
    """How its surface is seen; by default rays are cast through ``volume``."""
    near_m: float = NEAR_PLANE_M
    """Nearer Gaussians are not drawn, metres."""

    def surface_picture(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> SurfacePicture:
        """What a camera sees of the surface below the Gaussians, one ray for each pixel."""
        if self.look is None:
            surface = raycast(self.volume, camera, T_WC.to(self.volume.device))
            rgb = surface.rgb
            depth_m = surface.depth_m
        else:
            rgb, depth_m = self.look(camera, T_WC)
        return surface_picture(
            rgb,
            depth_m,
            (camera.height, camera.width),
            self.config.holes,
            self.config.behind_m,
        )

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
        """Surface and Gaussians seen by a camera; alpha is 1 where there is a surface, and depth is
        the surface's."""
        surface = self.surface_picture(camera, T_WC)
        device = self.volume.device
        output, _ = render_over_base(
            self.params,
            camera,
            T_WC.to(device),
            surface.base,
            behind_m=surface.behind_m,
            near_m=self.near_m,
        )
        return output.as_render_output(surface.base)

    @staticmethod
    def of_folder(folder: Path, params: GaussianParams, config: Any) -> "OverSurface":
        """The map of a finished run; ``params`` are its Gaussians, ``config`` its settings."""
        volume = read_tsdf(folder / TSDF, config.tsdf, params.xyz_W.device)
        return OverSurface(
            volume=volume, params=params, config=config.base, near_m=near_plane_m(config)
        )
