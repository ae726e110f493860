"""Brightness as a second witness of the pose: depth alone slides along flat surfaces, pictures on
them do not."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from ..backends import op, piece
from ..checks import check_number, check_positive
from ..errors import ArgumentError
from ..geometry import depth_to_points, project, se3
from ..geometry.operands import check_operand, check_view
from ..types import Camera
from .surface import DepthLevel, Surface, about_the_surface, reduced_camera

USUAL_ERROR = 0.05
"""Differences of brightness (0 = black, 1 = white) above this are mostly reflections, shadows and
occlusions: their weight is 1 / (1 + (r / this)^2) (Cauchy)."""

FLAT = 1e-3
"""A pixel whose brightness changes by less than this from one pixel to the next says nothing about
the pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """The surface's brightness at the size of one level of the pyramid, seen from the surface's
    pose."""

    camera: Camera
    brightness: Float[Tensor, "H W"]
    """Mean of red, green and blue, 0..1."""
    gradient: Float[Tensor, "H W 2"]
    """Its change from one pixel to the next, to the right and downwards; 0 where a neighbour is not
    known."""
    depth_m: Float[Tensor, "H W"]
    """z-depth at the middle of the pixel, metres; 0 where there is none."""
    T_WC: Float[Tensor, "4 4"]


@dataclass(frozen=True, kw_only=True, eq=False)
class BrightnessSystem:
    """Sums over the pixels that both see, float64."""

    gram: Float[Tensor, "8 8"]
    """sum w m m^T of the rows m = [J, r, 1], with r in units of brightness."""
    n: int
    """Number of pixels."""

    @property
    def offset(self) -> float:
        """Weighted mean of r: how much brighter the model is than the frame."""
        return float(self.gram[6, 7] / self.gram[7, 7].clamp_min(1e-12))

    @property
    def rms(self) -> float:
        """Weighted root mean square of r without its mean, units of brightness; 0 without
        pixels."""
        mean = self.gram[7, 7].clamp_min(1e-12)
        return float((self.gram[6, 6] / mean - self.offset**2).clamp_min(0.0).sqrt())

    def normal_equations(self) -> tuple[Float[Tensor, "6 6"], Float[Tensor, " 6"]]:
        """sum w J^T J and sum w J^T r, after an exposure that is the same for all pixels has been
        solved for.

        With r + J xi - e, the best e is the mean of the rest; put in, the means of J and r are
        taken away.
        """
        J1 = self.gram[:6, 7]
        r1 = self.gram[6, 7]
        w = self.gram[7, 7].clamp_min(1e-12)
        H = self.gram[:6, :6] - torch.outer(J1, J1) / w
        b = self.gram[:6, 6] - J1 * r1 / w
        return H, b


@piece
def brightness_rows(
    xyz: Float[Tensor, "N 3"],
    xyz_S: Float[Tensor, "N 3"],
    gradient: Float[Tensor, "N 2"],
    camera: Camera,
    R_WS: Tensor,
) -> Float[Tensor, "N 6"]:
    """Derivative of the picture's brightness at the projection of p with respect to a twist xi, p
    <- exp(xi) p.

    Args:
        xyz: Points p, relative to the centre of the surface's camera, along the axes of the world.
            [N, 3]
        xyz_S: The same points along the axes of that camera. [N, 3]
        gradient: Of the brightness, per pixel. [N, 2]
        camera: Of the picture.
        R_WS: Rotation of the surface's camera. [3, 3]

    Differentiable: yes, through torch. Source: Steinbruecker, Sturm & Cremers 2011.
    """
    x, y, z = xyz_S.unbind(-1)
    a = gradient[:, 0] * camera.fx / z
    b = gradient[:, 1] * camera.fy / z
    v_xyz = (
        torch.stack(
            [a, b, -(a * x + b * y) / z],
            dim=-1,
        )
        @ R_WS.T
    )
    return torch.cat([v_xyz, torch.linalg.cross(xyz, v_xyz)], dim=-1)


def check_brightness(
    level: Any,
    brightness: Any,
    T_WC: Any,
    picture: Any,
    *,
    max_distance_m: float,
    offset: float = 0.0,
) -> None:
    """Raise ``ValueError`` for arguments that ``brightness_system`` refuses."""
    for name, kind, value in (("level", DepthLevel, level), ("picture", Picture, picture)):
        if not isinstance(value, kind):
            raise ArgumentError(f"{name} must be a {kind.__name__}, got {type(value).__name__}")
    size = (level.camera.height, level.camera.width)
    check_operand("depth_m", level.depth_m, size)
    device = level.depth_m.device
    check_operand("brightness", brightness, size, device=device)
    check_view(level.camera, T_WC, device)
    size = (picture.camera.height, picture.camera.width)
    images = {
        "brightness": picture.brightness,
        "gradient": picture.gradient,
        "depth_m": picture.depth_m,
    }
    for name, image in images.items():
        channels = (2,) if name == "gradient" else ()
        check_operand(f"{name} of the picture", image, (*size, *channels), device=device)
    check_view(picture.camera, picture.T_WC, device)
    check_positive("max_distance_m", max_distance_m)
    check_number("offset", offset)


@op("brightness", check_brightness)
def brightness_system(
    level: DepthLevel,
    brightness: Float[Tensor, "H W"],
    T_WC: Float[Tensor, "4 4"],
    picture: Picture,
    *,
    max_distance_m: float,
    offset: float = 0.0,
) -> BrightnessSystem:
    """Sums of the brightness error about the pose ``T_WC``, for the same twist as ``icp_system``.

    Each point of the frame is projected into the picture. There the brightness is that of the
    nearest pixel q, carried on by its gradient:  r = I(q) + grad I(q) . (u - q) - I_frame.

    Args:
        level: A pyramid level of the frame.
        brightness: Its brightness, 0..1. [H, W]
        T_WC: Estimate of its camera-to-world pose. [4, 4]
        picture: The surface at this level.
        max_distance_m: Largest difference of depth of the point and the surface, metres.
        offset: How much brighter the picture is; it matters to the robust weights only.

    Differentiable: no. Source: Kerl, Sturm & Cremers 2013 (joint with depth); Park, Zhou & Koltun
    2017, Eq. 10-14 (the gradient that carries a colour on, there in the plane of the surface).
    """
    dtype = level.depth_m.dtype
    T, R_WS = about_the_surface(T_WC, picture.T_WC, dtype)
    xyz = se3.apply(T, depth_to_points(level.camera, level.depth_m)).view(-1, 3)
    xyz_S = xyz @ R_WS
    u, v = project(picture.camera, xyz_S).unbind(-1)
    H = picture.camera.height
    W = picture.camera.width
    is_ahead = (level.depth_m.view(-1) > 0) & (xyz_S[:, 2] > 0)
    in_width = (u >= 0) & (u < W)
    in_height = (v >= 0) & (v < H)
    in_image = is_ahead & in_width & in_height
    row = v.where(in_image, 0.0).long()
    column = u.where(in_image, 0.0).long()
    depth_m = picture.depth_m.to(dtype)[row, column]
    gradient = picture.gradient.to(dtype)[row, column]
    is_near = (depth_m > 0) & ((xyz_S[:, 2] - depth_m).abs() <= max_distance_m)
    rows = in_image & is_near & (gradient.square().sum(-1) >= FLAT**2)
    model_brightness = picture.brightness.to(dtype)[row, column]
    from_centre_u = u - column - 0.5
    from_centre_v = v - row - 0.5
    model_brightness = (
        model_brightness + gradient[:, 0] * from_centre_u + gradient[:, 1] * from_centre_v
    )
    r = (model_brightness - brightness.to(dtype).view(-1))[rows]
    J = brightness_rows(
        xyz[rows],
        xyz_S[rows],
        gradient[rows],
        picture.camera,
        R_WS,
    )
    m = torch.cat(
        [J, r[:, None], torch.ones_like(r)[:, None]],
        dim=1,
    ).double()
    w = 1.0 / (1.0 + ((r.double() - offset) / USUAL_ERROR) ** 2)
    return BrightnessSystem(
        gram=m.T @ (w[:, None] * m),
        n=int(rows.sum()),
    )


class Pictures:
    """Brightness of a frame and of the surface that it is aligned with, for each level of the
    pyramid."""

    def __init__(self, frame: dict[int, Tensor], surface: dict[int, Picture]):
        self.frame = frame
        self.surface = surface
        self.offset = 0.0
        """How much brighter the surface is than the frame, from the last step."""

    @classmethod
    def of(cls, frame: dict[int, Tensor], surface: Surface) -> "Pictures | None":
        """Those of a frame (factor of each level -> ``brightness_levels``) and a surface; None if
        it has no colours."""
        if surface.rgb is None:
            return None
        return cls(frame, {factor: picture_of(surface, surface.rgb, factor) for factor in frame})

    def system(self, level: DepthLevel, T_WC: Tensor, max_distance_m: float) -> BrightnessSystem:
        """``brightness_system`` of one level, with the offset of the step before."""
        options = {"max_distance_m": max_distance_m, "offset": self.offset}
        system = brightness_system(
            level, self.frame[level.factor], T_WC, self.surface[level.factor], **options
        )
        self.offset = system.offset
        return system


def brightness_levels(
    rgb: Float[Tensor, "H W 3"], factors: tuple[int, ...]
) -> dict[int, Float[Tensor, "h w"]]:
    """The mean of red, green and blue, reduced by each factor."""
    image = rgb.mean(dim=-1)
    return {factor: reduce_image(image, factor) for factor in factors}


def reduce_image(image: Float[Tensor, "H W"], factor: int) -> Float[Tensor, "h w"]:
    """Mean of each block of pixels; the last blocks may hold fewer."""
    return (
        avg_pool2d(image[None], factor, ceil_mode=True, count_include_pad=False)[0]
        if factor > 1
        else image
    )


def picture_of(surface: Surface, rgb: Float[Tensor, "H W 3"], factor: int) -> Picture:
    """The picture of a surface at one level; where a block or a neighbour has no depth, the
    gradient is 0."""
    brightness = reduce_image(rgb.mean(dim=-1), factor)
    has_surface = reduce_image((surface.depth_m > 0).to(brightness), factor) > 0.99
    padded_image = pad(
        brightness[None],
        (1, 1, 1, 1),
        mode="replicate",
    )[0]
    gradient_u = padded_image[1:-1, 2:] - padded_image[1:-1, :-2]
    gradient_v = padded_image[2:, 1:-1] - padded_image[:-2, 1:-1]
    gradient = torch.stack([gradient_u, gradient_v], dim=-1) / 2
    padded_mask = pad(has_surface, (1, 1, 1, 1))
    left_and_right = padded_mask[1:-1, 2:] & padded_mask[1:-1, :-2]
    above_and_below = padded_mask[2:, 1:-1] & padded_mask[:-2, 1:-1]
    has_neighbours = has_surface & left_and_right & above_and_below
    sizes = zip(has_surface.shape, surface.depth_m.shape, strict=True)
    row, column = (
        (torch.arange(n) * factor + factor // 2).clamp(max=full - 1) for n, full in sizes
    )
    return Picture(
        camera=reduced_camera(surface.camera, factor),
        brightness=brightness,
        gradient=gradient.where(has_neighbours[..., None], 0.0),
        depth_m=surface.depth_m[row[:, None], column],
        T_WC=surface.T_WC,
    )
