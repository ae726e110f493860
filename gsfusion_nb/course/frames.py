"""Exercises of chapter 1: pinhole, back-projection, poses, pixel centres."""

import math

import torch
from torch import Tensor

from ..geometry import camera as cameras
from ..geometry import se3
from ..types import Camera
from .exercise import Attempt, Wrong, exercise

SMALL_CAMERA = Camera(
    width=8,
    height=6,
    fx=10.0,
    fy=5.0,
    cx=4.0,
    cy=3.0,
)


def _project(camera: Camera, xyz_C: Tensor) -> Tensor:
    x, y, z = xyz_C.unbind(-1)
    return torch.stack(
        [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy],
        dim=-1,
    )


def _project_without_depth(camera: Camera, xyz_C: Tensor) -> Tensor:
    x, y, _ = xyz_C.unbind(-1)
    return torch.stack(
        [camera.fx * x + camera.cx, camera.fy * y + camera.cy],
        dim=-1,
    )


def _project_with_y_up(camera: Camera, xyz_C: Tensor) -> Tensor:
    x, y, z = xyz_C.unbind(-1)
    return torch.stack(
        [camera.fx * x / z + camera.cx, camera.cy - camera.fy * y / z],
        dim=-1,
    )


def _project_with_one_focal_length(camera: Camera, xyz_C: Tensor) -> Tensor:
    x, y, z = xyz_C.unbind(-1)
    return torch.stack(
        [camera.fx * x / z + camera.cx, camera.fx * y / z + camera.cy],
        dim=-1,
    )


def _project_to_whole_pixels(camera: Camera, xyz_C: Tensor) -> Tensor:
    return _project(camera, xyz_C).round()


@exercise(
    chapter=1,
    difficulty=1,
    minutes=5,
    solution=_project,
    replaces=(cameras.project,),
    hints=(
        "Similar triangles: a point twice as far away lands half as far from the principal point.",
        "u = fx x / z + cx, and the same for v.",
    ),
    wrong=(
        Wrong(_project_without_depth, says="twice as far"),
        Wrong(_project_with_y_up, says="y points down"),
        Wrong(_project_with_one_focal_length, says="v takes fy"),
        Wrong(_project_to_whole_pixels, says="between"),
    ),
)
def project_points(attempt: Attempt) -> None:
    """Project camera-frame points to pixels (Eq. 4)."""
    uv = attempt.on("a point on the optical axis, 2 m away")(
        SMALL_CAMERA, torch.tensor([[0.0, 0.0, 2.0]])
    )
    attempt.close(
        uv, [[4.0, 3.0]], "the optical axis meets the image at the principal point (cx, cy)"
    )
    uv = attempt.on("points (0.2, 0, 1) and (0.2, 0, 2)")(
        SMALL_CAMERA, torch.tensor([[0.2, 0.0, 1.0], [0.2, 0.0, 2.0]])
    )
    attempt.close(
        uv,
        [[6.0, 3.0], [5.0, 3.0]],
        "a point twice as far lands half as far from the principal point",
    )
    uv = attempt.on("a point 0.4 m below the axis, 2 m away")(
        SMALL_CAMERA, torch.tensor([[0.0, 0.4, 2.0]])
    )
    v = float(torch.as_tensor(uv).reshape(-1)[-1])
    axis_words = "y points down, in the camera's frame and in the image"
    attempt.holds(
        v > 3, axis_words, detail=f"v is {v:.5g}, but below the middle row 3 it is larger"
    )
    attempt.close(uv, [[4.0, 4.0]], "u takes fx and v takes fy: they may differ")
    uv = attempt.on("a point that projects between pixel centres")(
        SMALL_CAMERA, torch.tensor([[0.03, 0.01, 1.0]])
    )
    attempt.close(
        uv, [[4.3, 3.05]], "pixel coordinates are continuous: a point may fall between centres"
    )


def _lift(camera: Camera, uv: Tensor, depth_m: Tensor) -> Tensor:
    x = (uv[..., 0] - camera.cx) / camera.fx * depth_m
    y = (uv[..., 1] - camera.cy) / camera.fy * depth_m
    return torch.stack([x, y, depth_m], dim=-1)


def _lift_along_the_ray(camera: Camera, uv: Tensor, depth_m: Tensor) -> Tensor:
    ray = _lift(camera, uv, torch.ones_like(depth_m))
    return ray / ray.norm(dim=-1, keepdim=True) * depth_m[..., None]


def _lift_with_one_focal_length(camera: Camera, uv: Tensor, depth_m: Tensor) -> Tensor:
    xy = (uv - torch.tensor([camera.cx, camera.cy])) / camera.fx * depth_m[..., None]
    return torch.cat([xy, depth_m[..., None]], dim=-1)


@exercise(
    chapter=1,
    difficulty=2,
    minutes=8,
    solution=_lift,
    replaces=(cameras.backproject,),
    hints=(
        "Solve Eq. 4 for x and y; z is known.",
        "The ray ((u - cx) / fx, (v - cy) / fy, 1) has z = 1. What must it be multiplied by to get "
        "z = depth?",
    ),
    wrong=(
        Wrong(_lift_along_the_ray, says="the depth is z, not the distance to the camera"),
        Wrong(_lift_with_one_focal_length, says="fx and fy"),
    ),
)
def lift_pixels(attempt: Attempt) -> None:
    """Lift pixels with depth to camera-frame points (Eq. 10)."""
    uv = torch.tensor([[7.5, 5.5]])
    depth = torch.tensor([2.0])
    point = attempt.on("a corner pixel at depth 2 m")(SMALL_CAMERA, uv, depth)
    attempt.close(_last(point), [2.0], "the depth is z, not the distance to the camera")
    for where, pixel, reference, prop in (
        (
            "the pixel at the principal point",
            [4.0, 3.0],
            [0.0, 0.0, 2.0],
            "the principal point is straight ahead: x and y are 0",
        ),
        (
            "a pixel to the right of it",
            [7.5, 3.0],
            [0.7, 0.0, 2.0],
            "x = (u - cx) / fx, times the depth",
        ),
        (
            "a pixel below it",
            [4.0, 5.5],
            [0.0, 1.0, 2.0],
            "y = (v - cy) / fy, times the depth: fx and fy may differ",
        ),
    ):
        attempt.close(
            attempt.on(f"{where}, at depth 2 m")(SMALL_CAMERA, torch.tensor([pixel]), depth),
            [reference],
            prop,
        )
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(50, 2, generator=generator) * torch.tensor([8.0, 6.0])
    depth = 0.5 + torch.rand(50, generator=generator)
    uv_again = _project(
        SMALL_CAMERA,
        torch.as_tensor(
            attempt.on("many pixels, lifted and projected again")(SMALL_CAMERA, uv, depth)
        ),
    )
    attempt.close(uv_again, uv, "projecting the point gives the pixel back", tolerance=1e-4)


def _invert(T: Tensor) -> Tensor:
    inverse = torch.eye(4, dtype=T.dtype)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def _invert_parts_alone(T: Tensor) -> Tensor:
    inverse = torch.eye(4, dtype=T.dtype)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, 3]
    return inverse


def _invert_by_transposing(T: Tensor) -> Tensor:
    return T.T.contiguous()


@exercise(
    chapter=1,
    difficulty=2,
    minutes=8,
    solution=_invert,
    replaces=(se3.inverse,),
    hints=(
        "x_W = R x_C + t. Solve for x_C; R^-1 = R^T.",
        "x_C = R^T (x_W - t) = R^T x_W - R^T t: the translation is turned too.",
    ),
    wrong=(
        Wrong(_invert_parts_alone, says="lands at the origin"),
        Wrong(_invert_by_transposing, says="last row"),
    ),
)
def invert_pose(attempt: Attempt) -> None:
    """Turn T_WC into T_CW without a general matrix inverse."""
    attempt.close(
        attempt.on("the identity")(torch.eye(4)),
        torch.eye(4),
        "the inverse of the identity is the identity",
    )
    T = torch.eye(4)
    T[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    T[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    T_CW = torch.as_tensor(attempt.on("a quarter turn about z and a step of (1, 2, 3) m")(T))
    attempt.close(T_CW.shape, [4, 4], "the result is a 4 x 4 matrix")
    attempt.close(T_CW[3], [0.0, 0.0, 0.0, 1.0], "the last row of a pose is 0 0 0 1")
    attempt.close(
        T_CW[:3, :3],
        T[:3, :3].T,
        "the transpose undoes the rotation",
    )
    centre = T_CW @ torch.tensor([1.0, 2.0, 3.0, 1.0])
    attempt.close(
        centre[:3], [0.0, 0.0, 0.0], "the camera's centre lands at the origin of the camera's frame"
    )
    attempt.on("a pose in general position")
    T = se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.4, -0.7, 0.2]))
    attempt.close(
        torch.as_tensor(attempt(T)) @ T, torch.eye(4), "T_CW T_WC is the identity", tolerance=1e-4
    )


def _halve(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> tuple[float, float, float, float]:
    return fx / 2, fy / 2, (cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5


def _halve_everything(
    fx: float, fy: float, cx: float, cy: float
) -> tuple[float, float, float, float]:
    return fx / 2, fy / 2, cx / 2, cy / 2


def _halve_the_centre_alone(
    fx: float, fy: float, cx: float, cy: float
) -> tuple[float, float, float, float]:
    return fx, fy, (cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5


@exercise(
    chapter=1,
    difficulty=3,
    minutes=10,
    solution=_halve,
    hints=(
        "Where is the image's left edge, counted from the centre of its first pixel? And after "
        "halving?",
        "Count from the image's edge instead: add 0.5. Then halve. Then subtract 0.5 again.",
    ),
    wrong=(
        Wrong(_halve_everything, says="the middle of the image stays the middle"),
        Wrong(_halve_the_centre_alone, says="angle of view"),
    ),
)
def halve_intrinsics(attempt: Attempt) -> None:
    """Intrinsics of the half-size image, for a data set that counts pixels from the centre of the
    first one."""
    attempt.on("640 x 480 with fx = fy = 600, centre (319.5, 239.5)")
    names = ("fx", "fy", "cx", "cy")
    fx, fy, cx, cy = attempt.unpack(attempt(600.0, 600.0, 319.5, 239.5), names)
    prop = "half the pixels over the same angle of view: half the focal length"
    attempt.close(
        [fx, fy],
        [300.0, 300.0],
        prop,
        names=names[:2],
    )
    shift = max(abs(float(cx) - 159.5), abs(float(cy) - 119.5))
    why = f"a shift of {shift:.2f} px of the small image"
    attempt.close(
        [cx, cy],
        [159.5, 119.5],
        "the middle of the image stays the middle",
        why=why,
        names=names[2:],
    )
    attempt.on("a point off the axis, projected at both sizes")
    half = attempt.unpack(attempt(525.0, 520.0, 310.2, 251.7), names)
    x = 0.3
    y = -0.2
    full = (525.0 * x + 310.2 + 0.5, 520.0 * y + 251.7 + 0.5)
    small = (half[0] * x + half[2] + 0.5, half[1] * y + half[3] + 0.5)
    prop = "measured from the image's edge, the point is half as far"
    attempt.close(small, [f / 2 for f in full], prop, tolerance=1e-6)


def _last(point: object) -> Tensor:
    """z of a point, of whatever type the student returned."""
    t = torch.as_tensor(point)
    return t[..., -1] if t.ndim else torch.full((1,), math.nan)
