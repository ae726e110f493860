"""Checks of what operations, mappers and tools are given: cameras, poses, depth images,
Gaussians."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_finite, check_shape
from ..errors import ArgumentError
from ..types import Camera, Frame, GaussianParams

FLOATS = (torch.float32, torch.float64)
INTEGERS = (torch.int64, torch.int32)
MASK = (torch.bool,)

MOST_GAUSSIANS = 1 << 24
"""Rows that an image of indices can tell apart: kernels carry them as float32."""


def check_operand(
    name: str,
    value: object,
    shape: tuple[int | str, ...],
    *,
    dtypes: tuple[torch.dtype, ...] = FLOATS,
    device: torch.device | None = None,
) -> None:
    """Raise ``ValueError`` unless ``value`` is a tensor of this shape, of one of the types, on the
    device.

    Args:
        name: For the sentence.
        value: The argument.
        shape: A string stands for any length.
        dtypes: Allowed types of numbers.
        device: Where it must be; anywhere by default.
    """
    check_shape(name, value, shape)
    assert isinstance(value, Tensor)
    if value.dtype not in dtypes:
        types = "boolean" if dtypes is MASK else " or ".join(str(t) for t in dtypes)
        raise ArgumentError(
            f"{name} must be {types}, got {value.dtype}; convert it with .to({dtypes[0]})"
        )
    if device is None and value.is_meta:
        raise ArgumentError(
            f"{name} must hold numbers, got a tensor on the device meta, which has none"
        )
    if device is not None and not _is_on(value.device, device):
        raise ArgumentError(
            f"{name} must be on {device}, got a tensor on {value.device}; move it with "
            f".to({str(device)!r})"
        )


def check_gaussians(params: Any, like: GaussianParams | None = None) -> None:
    """Raise ``ValueError`` unless the columns of ``params`` fit together (or, as gradients, those
    of ``like``)."""
    if not isinstance(params, GaussianParams):
        raise ArgumentError(f"params must be GaussianParams, got {type(params).__name__}")
    if like is not None and _same_layout(params, like):
        return
    first = params.xyz_W if like is None else like.xyz_W
    if like is None:
        check_operand("xyz_W", first, ("N", 3))
    else:
        check_operand(
            "xyz_W",
            params.xyz_W,
            (len(first), 3),
            dtypes=(first.dtype,),
            device=first.device,
        )
    n = len(first)
    K = "K" if like is None else like.sh.shape[1]
    for name, shape in (
        ("log_scale", (n, 3)),
        ("quat", (n, 4)),
        ("opacity_logit", (n,)),
        ("sh", (n, K, 3)),
    ):
        check_operand(
            name,
            getattr(params, name),
            shape,
            dtypes=(first.dtype,),
            device=first.device,
        )
    if params.sh.shape[1] not in (1, 4, 9, 16):
        raise ArgumentError(
            "sh must be [N, K, 3] with K = 1, 4, 9 or 16 (degree 0 to 3), got K = "
            f"{params.sh.shape[1]}"
        )
    if n >= MOST_GAUSSIANS:
        raise ArgumentError(f"a map may have fewer than 2^24 Gaussians, got {n}; leave some out")


def _same_layout(a: GaussianParams, b: GaussianParams) -> bool:
    """Whether all columns have the same shape, type of numbers and device: the usual case, found
    quickly."""
    return all(
        isinstance(x, Tensor) and x.shape == y.shape and x.dtype == y.dtype and x.device == y.device
        for x, y in zip(
            vars(a).values(),
            vars(b).values(),
            strict=True,
        )
    )


def check_camera(camera: Any) -> None:
    """Raise ``ValueError`` unless this is a camera; its numbers were checked when it was made."""
    if not isinstance(camera, Camera):
        raise ArgumentError(f"camera must be a Camera, got {type(camera).__name__}")


def check_view(camera: Any, T_WC: Any, device: torch.device) -> None:
    """Raise ``ValueError`` unless this is a camera and a finite pose, on ``device`` or on the
    processor.

    A pose on a GPU is not waited for: with a NaN in it nothing is seen.
    """
    check_camera(camera)
    on_cpu = getattr(T_WC, "device", device).type == "cpu"
    check_operand("T_WC", T_WC, (4, 4), device=None if on_cpu else device)
    if on_cpu and not math.isfinite(sum(map(sum, T_WC.tolist()))):
        check_finite("T_WC", T_WC)


def check_frame_on(frame: Any, device: torch.device) -> None:
    """Raise ``ValueError`` unless this is a frame with its images on ``device``."""
    if not isinstance(frame, Frame):
        raise ArgumentError(f"frame must be a Frame, got {type(frame).__name__}")
    for name in ("colour", "depth_m", "T_WC"):
        where = getattr(frame, name).device
        if not _is_on(where, device) and not (name == "T_WC" and where.type == "cpu"):
            raise ArgumentError(
                f"the frame must be on {device}, got its {name} on {where}; move it with "
                f".to({str(device)!r})"
            )


def check_images(**images: Any) -> None:
    """Raise ``ValueError`` unless all are images of one size, type and device. A name with "depth"
    is [H, W]."""
    (name, first), *others = images.items()
    check_operand(name, first, ("H", "W", 3))
    size = tuple(first.shape[:2])
    for other, image in others:
        shape = size if "depth" in other else (*size, 3)
        check_operand(other, image, shape, dtypes=(first.dtype,), device=first.device)


def _is_on(place: torch.device, device: torch.device) -> bool:
    """Both are the same; "cuda" without a number is any GPU, since tensors on it say "cuda:0"."""
    return place.type == device.type and (device.index is None or place.index == device.index)


FOCAL_PER_SIDE = (0.05, 100.0)
"""Focal length in units of the image's side: fields of view from 169 down to 0.6 degrees."""
PIXEL_ASPECT = 10.0
"""fx and fy differ by at most this factor; pixels of cameras are square, and images may be resized
along one side."""
CENTRE_SIDES = (-1.0, 2.0)
"""Place of the principal point in units of the image's side; 0 and 1 are the image's edges."""
MAX_DISTANCE_M = 10_000.0
"""Distance of anything from the origin, metres: farther out float32 cannot hold a millimetre."""
DEPTH_SCALE = (1.0, 1_000_000.0)
"""Stored depth value of one metre: from metres to micrometres."""

LEAST_SIDE_PX = 2
"""Side of an image, pixels: gradients and the points between pixels need neighbours."""


def check_plausible_camera(source: str, camera: Camera) -> None:
    """Raise ``ValueError`` for an impossible camera; the sentence begins with ``source``."""
    c = camera
    shortest, longest = FOCAL_PER_SIDE
    first, last = CENTRE_SIDES
    for name, value, low, high in (
        ("the image's smaller side", min(c.width, c.height), LEAST_SIDE_PX, math.inf),
        ("fx", c.fx, shortest * c.width, longest * c.width),
        ("fy", c.fy, shortest * c.height, longest * c.height),
        ("cx", c.cx, first * c.width, last * c.width),
        ("cy", c.cy, first * c.height, last * c.height),
        ("fx / fy", c.fx / c.fy, 1 / PIXEL_ASPECT, PIXEL_ASPECT),
    ):
        if not low <= value <= high:
            size = f"{c.width} x {c.height} pixels"
            raise ArgumentError(
                f"{source}: {name} must be between {low:g} and {high:g} for {size}, got {value:g}"
            )


def check_rays(source: str, camera: Camera) -> None:
    """Raise ``ValueError`` if a ray runs further sideways than those of any plausible camera; a
    picture may be small.

    The sentence begins with ``source``.
    """
    most = CENTRE_SIDES[1] / FOCAL_PER_SIDE[0]
    sides = (("x", camera.fx, camera.cx, camera.width), ("y", camera.fy, camera.cy, camera.height))
    for axis, focal, centre, size in sides:
        sideways = max(abs(centre), abs(size - centre)) / focal
        if not sideways <= most:
            raise ArgumentError(
                f"{source}: f{axis} = {focal:g} and c{axis} = {centre:g} make a ray run "
                f"{sideways:.3g} m sideways per metre of depth; expected at most {most:g}"
            )


def check_place(source: str, T_WC: Float[Tensor, "4 4"]) -> None:
    """Raise ``ValueError`` if the camera is too far from the origin; the sentence begins with
    ``source``."""
    if float(T_WC[:3, 3].abs().max()) > MAX_DISTANCE_M:
        place = ", ".join(f"{float(v):.4g}" for v in T_WC[:3, 3])
        raise ArgumentError(
            f"{source} must be within {MAX_DISTANCE_M / 1000:g} km of the origin, got ({place}) m: "
            "is the unit metres? Of map coordinates, subtract one origin from all poses"
        )


def check_depth_scale(source: str, scale: float) -> None:
    """Raise ``ValueError`` if no depth of one metre is stored as ``scale``; the sentence begins
    with ``source``."""
    low, high = DEPTH_SCALE
    if not low <= scale <= high:
        inverse = f"; is it {1 / scale:g}, the inverse?" if 0 < scale < low else ""
        raise ArgumentError(
            f"{source}: the depth scale, the stored value of one metre, must be between {low:g} "
            f"and {high:g}, got {scale:g}{inverse}"
        )
