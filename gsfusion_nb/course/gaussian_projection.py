"""The whole projection of a Gaussian, and its gradient, assembled: exercises of chapters 4 and
5."""

import torch
from torch import Tensor

from ..geometry import quaternion, se3
from ..render.constants import ALPHA_MIN, FARTHEST_PX, FRUSTUM_CLAMP, NEAR_PLANE_M, SCREEN_BLUR_PX2
from ..render.project import Projection, ProjectionGradient
from ..types import Camera, GaussianParams
from .exercise import Attempt, Becomes, Wrong, Yours, exercise

Ellipse = tuple[Tensor, Tensor, Tensor]


def _tangent(camera: Camera, xyz_C: Tensor) -> Tensor:
    """J at a point, its direction limited to 1.3 times the half angle of view."""
    x, y, z = xyz_C
    limit_x = FRUSTUM_CLAMP * camera.width / 2 / camera.fx
    limit_y = FRUSTUM_CLAMP * camera.height / 2 / camera.fy
    tx = (x / z).clamp(-limit_x, limit_x)
    ty = (y / z).clamp(-limit_y, limit_y)
    o = torch.zeros_like(z)
    rows = [
        torch.stack([camera.fx / z, o, -camera.fx * tx / z]),
        torch.stack([o, camera.fy / z, -camera.fy * ty / z]),
    ]
    return torch.stack(rows)


def _ellipse(camera: Camera, xyz_C: Tensor, J: Tensor, B: Tensor) -> Ellipse:
    """Centre, conic and depth, from B = W R S."""
    x, y, z = xyz_C
    M = J @ B
    Q = (M @ M.T + SCREEN_BLUR_PX2 * torch.eye(2).to(M)).inverse()
    uv = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    return uv, torch.stack([Q[0, 0], Q[0, 1], Q[1, 1]]), z


def _project(
    camera: Camera, T_CW: Tensor, xyz_W: Tensor, log_scale: Tensor, quat: Tensor
) -> Ellipse:
    W = T_CW[:3, :3]
    xyz_C = W @ xyz_W + T_CW[:3, 3]
    B = W @ quaternion.to_matrix(quat) @ torch.diag(log_scale.exp())
    return _ellipse(camera, xyz_C, _tangent(camera, xyz_C), B)


def _camera_not_turned(
    camera: Camera, T_CW: Tensor, xyz_W: Tensor, log_scale: Tensor, quat: Tensor
) -> Ellipse:
    xyz_C = se3.apply(T_CW, xyz_W)
    B = quaternion.to_matrix(quat) @ torch.diag(log_scale.exp())
    return _ellipse(camera, xyz_C, _tangent(camera, xyz_C), B)


def _world_for_camera(
    camera: Camera, T_CW: Tensor, xyz_W: Tensor, log_scale: Tensor, quat: Tensor
) -> Ellipse:
    return _project(camera, se3.inverse(T_CW), xyz_W, log_scale, quat)


def _covariance_for_conic(
    camera: Camera, T_CW: Tensor, xyz_W: Tensor, log_scale: Tensor, quat: Tensor
) -> Ellipse:
    uv, (A, B, C), z = _project(camera, T_CW, xyz_W, log_scale, quat)
    return uv, torch.stack([C, -B, A]) / (A * C - B * B), z


def _logarithm_kept(
    camera: Camera, T_CW: Tensor, xyz_W: Tensor, log_scale: Tensor, quat: Tensor
) -> Ellipse:
    return _project(camera, T_CW, xyz_W, log_scale.abs().log(), quat)


def _unlimited(
    camera: Camera, T_CW: Tensor, xyz_W: Tensor, log_scale: Tensor, quat: Tensor
) -> Ellipse:
    xyz_C = se3.apply(T_CW, xyz_W)
    x, y, z = xyz_C.tolist()
    J = xyz_C.new_tensor(
        [[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]]
    )
    return _ellipse(
        camera,
        xyz_C,
        J,
        T_CW[:3, :3] @ quaternion.to_matrix(quat) @ torch.diag(log_scale.exp()),
    )


def _in_front(params: GaussianParams, T_CW: Tensor) -> tuple[Tensor, Tensor]:
    """Depths, and the rows in front of the near plane that hold no NaN or infinity."""
    depth_m = se3.apply(T_CW, params.xyz_W)[:, 2]
    finite = torch.cat([params.xyz_W, params.log_scale, params.quat], dim=1).isfinite().all(1)
    return depth_m, finite & (depth_m > NEAR_PLANE_M)


def _as_project_gaussians(
    yours: Yours, params: GaussianParams, camera: Camera, T_WC: Tensor
) -> Projection:
    """Yours in float64 for each Gaussian in front of the camera; opacity and extent follow from the
    conic."""
    T_CW = se3.inverse(T_WC.to(params.xyz_W))
    depth_m, rows = _in_front(params, T_CW)
    opacity = params.opacity_logit.sigmoid()
    uv = depth_m.new_zeros(len(params), 2)
    conic = depth_m.new_zeros(len(params), 3)
    extent_px = torch.zeros_like(uv)
    T = T_CW.double()
    none = torch.zeros((), dtype=torch.float64)
    for k in rows.nonzero()[:, 0].tolist():
        inputs = (params.xyz_W[k].double(), params.log_scale[k].double(), params.quat[k].double())
        like = {"uv": uv[k].double(), "conic": conic[k].double(), "depth_m": none}
        centre, (A, B, C), z = yours(camera, T, *inputs, gives=like)
        determinant = A * C - B * B
        if not (determinant > 0 and A > 0):
            yours.fail(
                f"returned a conic {[float(A), float(B), float(C)]}, which is no ellipse",
                (camera, T_CW, *inputs),
            )
        reach = 2 * (opacity[k].double() / ALPHA_MIN).clamp_min(1.0).log()
        uv[k] = centre
        conic[k] = torch.stack([A, B, C])
        depth_m[k] = z
        extent_px[k] = (reach * torch.stack([C, A]) / determinant).sqrt()
    finite = depth_m.isfinite() & ((uv.abs() < FARTHEST_PX) & (extent_px < FARTHEST_PX)).all(1)
    values = {
        "uv": uv,
        "conic": conic,
        "depth_m": depth_m,
        "opacity": opacity,
        "extent_px": extent_px,
    }
    columns = {
        name: torch.where(
            finite.view(-1, *[1] * (x.ndim - 1)),
            x,
            0.0,
        )
        for name, x in values.items()
    }
    return Projection(**columns, visible=rows & finite & (opacity >= ALPHA_MIN))


_CAMERA = Camera(
    width=80,
    height=60,
    fx=60.0,
    fy=50.0,
    cx=41.0,
    cy=29.0,
)
_NAMES = ("uv", "conic", "depth_m")


@exercise(
    chapter=4,
    difficulty=4,
    minutes=20,
    solution=_project,
    becomes=Becomes("project_gaussians", _as_project_gaussians),
    hints=(
        "xyz_C = W xyz_W + t, with W = T_CW[:3, :3] and t = T_CW[:3, 3]. uv is the pinhole of it.",
        "B = W R S is the shape in the camera frame, R = quaternion.to_matrix(quat), S = "
        "diag(exp(log_scale)). Then cov = (J B) (J B)^T + 0.3 I, with the J of section 2.",
        "J holds x/z and y/z. Limit these two, only there: x/z to +-1.3 * width / (2 fx), y/z to "
        "+-1.3 * height / (2 fy).",
        "The conic is (Q[0, 0], Q[0, 1], Q[1, 1]) of Q = inverse of cov.",
    ),
    wrong=(
        Wrong(_world_for_camera, says="T_CW takes world coordinates to the camera's"),
        Wrong(_covariance_for_conic, says="the conic is the inverse"),
        Wrong(_logarithm_kept, says="S = diag(exp(log_scale))"),
        Wrong(_camera_not_turned, says="the ellipse turns with the camera"),
        Wrong(_unlimited, says="far outside the picture"),
    ),
)
def project_gaussian(attempt: Attempt) -> None:
    """From a row of the map to an ellipse in the picture: centre, conic and depth of one
    Gaussian."""
    f64 = torch.float64
    eye = torch.eye(4, dtype=f64)
    centre = torch.tensor([0.0, 0.0, 2.0], dtype=f64)
    ball = torch.full((3,), 0.1, dtype=f64).log()
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=f64)

    def ask(case: str, T_CW: Tensor, *row: Tensor) -> Ellipse:
        return attempt.unpack(attempt.on(case)(_CAMERA, T_CW, *row), _NAMES)

    T_shifted = eye.clone()
    T_shifted[:3, 3] = torch.tensor([0.0, 0.0, 1.0])
    case = "a ball of 10 cm at z = 2 m, seen from 1 m behind the world's origin"
    uv, conic, depth_m = ask(case, T_shifted, centre, ball, upright)
    attempt.close(depth_m, 3.0, "T_CW takes world coordinates to the camera's")
    attempt.close(uv, [41.0, 29.0], "straight ahead is the principal point")
    _, conic, _ = ask("the same ball from the origin", eye, centre, ball, upright)
    reference = _project(_CAMERA, eye, centre, ball, upright)[1]
    A = float(torch.as_tensor(conic).reshape(-1)[0])
    why = f"cov is 9.3 px^2, and its inverse {1 / 9.3:.3g}"
    if abs(A - 9.3) < 1e-3:
        attempt.close(conic, reference, "the conic is the inverse of the covariance", why=why)
    attempt.close(
        conic,
        reference,
        "the conic of J W R S S^T R^T W^T J^T + 0.3 I, with S = diag(exp(log_scale))",
        why=why,
    )
    needle = torch.tensor([0.3, 0.05, 0.02], dtype=f64).log()
    quat = torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=f64)
    T_rotated = se3.exp(torch.tensor([0.1, -0.2, 0.3, 0.3, -0.4, 0.8], dtype=f64))
    uv, conic, depth_m = ask(
        "a tilted needle before a turned camera", T_rotated, centre, needle, quat
    )
    reference = _project(_CAMERA, T_rotated, centre, needle, quat)
    attempt.close(uv, reference[0], "u = fx x/z + cx, v = fy y/z + cy")
    attempt.close(conic, reference[1], "the ellipse turns with the camera: M = J W R S")
    case = "a needle far outside the picture, x/z = 2.5"
    aside = torch.tensor([2.5, 0.2, 1.0], dtype=f64)
    _, conic, _ = ask(case, eye, aside, needle, quat)
    reference = _project(_CAMERA, eye, aside, needle, quat)
    attempt.close(
        conic,
        reference[1],
        "far outside the picture, J is that of 1.3 times the half angle of view",
    )
    attempt.close(
        ask(case, eye, aside, needle, quat)[0], reference[0], "only J is limited, not the centre"
    )
    case = "a needle far above the picture, y/z = -1.9"
    high_centre = torch.tensor([0.2, -2.5, 1.3], dtype=f64)
    reference = _project(_CAMERA, eye, high_centre, needle, quat)
    attempt.close(
        ask(case, eye, high_centre, needle, quat)[1],
        reference[1],
        "y/z is limited in J, too: 1.3 height / (2 fy)",
    )


def _project_vjp(camera, T_CW, xyz_W, log_scale, quat, v_uv, v_conic, v_depth_m) -> Ellipse:
    W = T_CW[:3, :3]
    R = quaternion.to_matrix(quat)
    s = log_scale.exp()
    x, y, z = xyz_C = W @ xyz_W + T_CW[:3, 3]
    J = _tangent(camera, xyz_C)
    B = W @ R @ torch.diag(s)
    M = J @ B
    Q = (M @ M.T + SCREEN_BLUR_PX2 * torch.eye(2).to(M)).inverse()
    v_A, v_B, v_C = v_conic
    v_Q = torch.stack([torch.stack([v_A, v_B / 2]), torch.stack([v_B / 2, v_C])])
    v_M = 2 * (-Q @ v_Q @ Q) @ M
    v_J = v_M @ B.T
    v_shape = J.T @ v_M
    v_log_scale = s * ((W @ R) * v_shape).sum(0)
    v_quat = quaternion.to_matrix_vjp(quat, W.T @ v_shape @ torch.diag(s))
    free_x = J[0, 2] == -camera.fx * (x / z) / z
    free_y = J[1, 2] == -camera.fy * (y / z) / z
    v_x = camera.fx / z * v_uv[0] - torch.where(free_x, camera.fx / z**2 * v_J[0, 2], 0.0)
    v_y = camera.fy / z * v_uv[1] - torch.where(free_y, camera.fy / z**2 * v_J[1, 2], 0.0)
    v_z = v_depth_m - (x * v_x + y * v_y + (J * v_J).sum()) / z
    return W.T @ torch.stack([v_x, v_y, v_z]), v_log_scale, v_quat


def _shape_ignored(camera, T_CW, xyz_W, log_scale, quat, v_uv, v_conic, v_depth_m) -> Ellipse:
    return _project_vjp(camera, T_CW, xyz_W, log_scale, quat, v_uv, 0 * v_conic, v_depth_m)


def _left_in_the_camera(camera, T_CW, xyz_W, log_scale, quat, v_uv, v_conic, v_depth_m) -> Ellipse:
    v_xyz, v_log, v_quat = _project_vjp(
        camera, T_CW, xyz_W, log_scale, quat, v_uv, v_conic, v_depth_m
    )
    return T_CW[:3, :3] @ v_xyz, v_log, v_quat


def _J_held_fixed(camera, T_CW, xyz_W, log_scale, quat, v_uv, v_conic, v_depth_m) -> Ellipse:
    centre = _project_vjp(
        camera,
        T_CW,
        xyz_W,
        log_scale,
        quat,
        v_uv,
        0 * v_conic,
        v_depth_m,
    )[0]
    return centre, *_project_vjp(camera, T_CW, xyz_W, log_scale, quat, v_uv, v_conic, v_depth_m)[1:]


def _as_project_gaussians_vjp(
    yours: Yours,
    params: GaussianParams,
    camera: Camera,
    T_WC: Tensor,
    v_uv: Tensor,
    v_conic: Tensor,
    v_depth_m: Tensor,
    v_opacity: Tensor,
) -> ProjectionGradient:
    """Yours in float64 for each Gaussian in front of the camera that some pixel moves."""
    T_CW = se3.inverse(T_WC.to(params.xyz_W))
    gradients = (
        torch.cat([v_uv, v_conic, v_depth_m[:, None]], dim=1).any(1) & _in_front(params, T_CW)[1]
    )
    gradient = {
        name: torch.zeros_like(getattr(params, name)) for name in ("xyz_W", "log_scale", "quat")
    }
    for k in gradients.nonzero()[:, 0].tolist():
        row = [getattr(params, name)[k].double() for name in gradient]
        like = {f"v_{name}": value for name, value in zip(gradient, row, strict=True)}
        v = (v_uv[k].double(), v_conic[k].double(), v_depth_m[k].double())
        for column, value in zip(
            gradient.values(),
            yours(camera, T_CW.double(), *row, *v, gives=like),
            strict=True,
        ):
            column[k] = value
    opacity = params.opacity_logit.sigmoid()
    return ProjectionGradient(**gradient, opacity_logit=v_opacity * opacity * (1 - opacity))


@exercise(
    chapter=5,
    difficulty=5,
    minutes=40,
    solution=_project_vjp,
    becomes=Becomes("project_gaussians_vjp", _as_project_gaussians_vjp),
    hints=(
        "Compute J, B = W R S, M = J B and Q forwards first, as in chapter 4. Then go through the "
        "table backwards.",
        "v_Q has v_A and v_C on its diagonal and v_B / 2 twice beside it; v_cov = -Q v_Q Q "
        "(exercise 5.4).",
        "v_M = 2 v_cov M;  v_J = v_M B^T;  v_B = J^T v_M;  v_log_scale = exp(log_scale) * column "
        "sums of (W R) * v_B;  "
        "v_R = W^T v_B S, and quaternion.to_matrix_vjp(quat, v_R) does the rest.",
        "The centre: exercise 5.5 gives the part of v_uv, v_depth_m belongs to z, and J depends on "
        "the centre, too: x on J[0, 2] = -fx x / z^2, y on J[1, 2], z on all four entries.",
        "Every entry of J is 1/z times something in x/z, y/z: v_z = v_depth_m - (x v_x + y v_y + "
        "sum(J * v_J)) / z, "
        "where v_x and v_y contain both parts. At the end v_xyz_W = W^T v_xyz_C.",
    ),
    wrong=(
        Wrong(_left_in_the_camera, says="back to the world"),
        Wrong(_shape_ignored, says="v_log_scale agrees with autograd"),
        Wrong(_J_held_fixed, says="J moves with the centre"),
    ),
)
def project_gaussian_vjp(attempt: Attempt) -> None:
    """Gradient of the projection of one Gaussian: from centre, conic and depth to its row of the
    map."""
    f64 = torch.float64
    names = ("v_xyz_W", "v_log_scale", "v_quat")
    T_rotated = se3.exp(torch.tensor([0.1, -0.2, 0.3, 0.3, -0.4, 0.8], dtype=f64))
    centre = se3.apply(
        se3.inverse(T_rotated),
        torch.tensor([0.3, -0.2, 2.0], dtype=f64),
    )
    needle = torch.tensor([0.3, 0.05, 0.1], dtype=f64).log()
    quat = torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=f64)
    v_uv = torch.tensor([0.7, -0.4], dtype=f64)
    v_conic = torch.tensor([20.0, 30.0, -10.0], dtype=f64)
    v_depth_m = torch.tensor(0.5, dtype=f64)

    def both(case: str, xyz_W: Tensor, *v: Tensor) -> tuple[tuple, tuple]:
        got = attempt.unpack(
            attempt.on(case)(_CAMERA, T_rotated, xyz_W, needle, quat, *v),
            names,
        )
        leaves = [x.clone().requires_grad_() for x in (xyz_W, needle, quat)]
        outputs = _project(_CAMERA, T_rotated, *leaves)
        loss = torch.stack([(a * b).sum() for a, b in zip(outputs, v, strict=True)]).sum()
        right = torch.autograd.grad(loss, leaves, allow_unused=True)
        return got, tuple(
            torch.zeros_like(x) if r is None else r for x, r in zip(leaves, right, strict=True)
        )

    got, right = both(
        "only the centre counts: dL/dconic = 0, dL/ddepth = 0",
        centre,
        v_uv,
        0 * v_conic,
        0 * v_depth_m,
    )
    attempt.close(
        got[0], right[0], "the gradient of the centre goes back to the world: W^T v_xyz_C"
    )
    got, right = both(
        "only the depth counts: dL/duv = 0, dL/dconic = 0", centre, 0 * v_uv, 0 * v_conic, v_depth_m
    )
    attempt.close(got[0], right[0], "v_depth_m belongs to z")
    got, right = both(
        "only the shape counts: dL/duv = 0, dL/ddepth = 0", centre, 0 * v_uv, v_conic, 0 * v_depth_m
    )
    attempt.close(got[1], right[1], "v_log_scale agrees with autograd")
    attempt.close(got[2], right[2], "v_quat agrees with autograd")
    attempt.close(got[0], right[0], "J moves with the centre, so the shape has a gradient by it")
    aside = se3.apply(
        se3.inverse(T_rotated),
        torch.tensor([2.5, 0.2, 1.0], dtype=f64),
    )
    got, right = both(
        "everything, and a Gaussian far outside the picture", aside, v_uv, v_conic, v_depth_m
    )
    attempt.close(got[0], right[0], "where x/z is limited in J, x has no gradient through J")
    high_centre = se3.apply(
        se3.inverse(T_rotated),
        torch.tensor([0.2, -2.5, 1.3], dtype=f64),
    )
    got, right = both(
        "a Gaussian far above the picture, 1.3 m ahead", high_centre, v_uv, v_conic, v_depth_m
    )
    attempt.close(got[0], right[0], "where y/z is limited in J, y has no gradient through J")
