"""Exercises of chapter 8: ICP, prediction of the next pose, and the correction after a loop
closure."""

from typing import Any

import torch
from torch import Tensor

from ..geometry import se3
from ..tracking.icp_step import Step
from ..tracking.icp_system import IcpSystem
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


def _residual_and_jacobian(p: Tensor, q: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    return ((p - q) * n).sum(-1), torch.cat([n, torch.linalg.cross(p, n)], -1)


def _point_to_point(p: Tensor, q: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    return (p - q).norm(dim=-1), _residual_and_jacobian(p, q, n)[1]


def _turned_round(p: Tensor, q: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    return ((p - q) * n).sum(-1), torch.cat([n, torch.linalg.cross(n, p)], -1)


def _rotation_first(p: Tensor, q: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    return ((p - q) * n).sum(-1), torch.cat([torch.linalg.cross(p, n), n], -1)


def _as_point_to_plane(
    yours: Yours,
    p: Tensor,
    q: Tensor,
    n: Tensor,
) -> tuple[Tensor, Tensor]:
    """Yours for all correspondences."""
    return yours(
        p,
        q,
        n,
        gives={"r": p.new_zeros(len(p)), "J": p.new_zeros(len(p), 6)},
    )


@exercise(
    chapter=8,
    difficulty=3,
    minutes=12,
    solution=_residual_and_jacobian,
    becomes=Becomes("point_to_plane", _as_point_to_plane),
    hints=(
        "The residual is a signed number: how far p is from the plane through q, along n.",
        "A small motion moves p by rho + omega x p. The dot product of this with n is n.rho + "
        "n.(omega x p).",
        "n.(omega x p) = omega.(p x n), the triple product. So a row of J is [n, p x n].",
    ),
    wrong=(
        Wrong(_point_to_point, says="sliding along the surface costs nothing"),
        Wrong(_rotation_first, says="the translation comes first"),
        Wrong(_turned_round, says="J is the derivative of r"),
    ),
)
def point_to_plane(attempt: Attempt) -> None:
    """Residual and Jacobian of point-to-plane ICP (Eq. 10)."""
    names = ("r", "J")
    normal = torch.tensor([[0.0, 0.0, 1.0]])
    attempt.on("a point 3 cm above the plane and 20 cm beside its partner")
    r, J = attempt.unpack(
        attempt(torch.tensor([[0.2, 0.0, 0.03]]), torch.zeros(1, 3), normal),
        names,
    )
    why = "only the part along n counts: (p - q) . n"
    has_wrong_sign = (
        torch.as_tensor(r).numel() == 1 and abs(float(torch.as_tensor(r)) + 0.03) < 1e-5
    )
    prop = "r is positive on the side to which n points: (p - q) . n"
    attempt.holds(not has_wrong_sign, prop, detail="got -0.03, expected 0.03")
    attempt.close(r, [0.03], "sliding along the surface costs nothing", why=why)
    attempt.holds(
        tuple(getattr(J, "shape", ())) == (1, 6),
        "J has six columns for each point",
        detail="expected [N, 6]",
    )
    attempt.close(
        torch.as_tensor(J)[:, :3],
        normal,
        "the translation comes first",
        why="dr/drho = n",
    )
    generator = torch.Generator().manual_seed(2)
    p, q, n = (torch.randn(5, 3, generator=generator, dtype=torch.float64) for _ in range(3))
    n = n / n.norm(dim=-1, keepdim=True)
    r, J = map(
        torch.as_tensor,
        attempt.unpack(attempt.on("five random points")(p, q, n), names),
    )
    attempt.close(r, ((p - q) * n).sum(-1), "r = (p - q) . n")
    step = 1e-6
    for k in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[k] = step
        residuals = [((se3.apply(se3.exp(s * xi), p) - q) * n).sum(-1) for s in (1.0, -1.0)]
        difference = (residuals[0] - residuals[1]) / (2 * step)
        attempt.on(f"five random points, finite difference in xi[{k}]")
        attempt.close(
            J[:, k], difference, "J is the derivative of r", why="a row of J is [n, p x n]"
        )


def _gauss_newton(T_WC: Tensor, r: Tensor, J: Tensor) -> Tensor:
    xi = torch.linalg.solve(J.T @ J, -J.T @ r)
    return se3.exp(xi) @ T_WC


def _plus_sign(T_WC: Tensor, r: Tensor, J: Tensor) -> Tensor:
    return se3.exp(torch.linalg.solve(J.T @ J, J.T @ r)) @ T_WC


def _right_side(T_WC: Tensor, r: Tensor, J: Tensor) -> Tensor:
    return T_WC @ se3.exp(torch.linalg.solve(J.T @ J, -J.T @ r))


def _gradient_descent(T_WC: Tensor, r: Tensor, J: Tensor) -> Tensor:
    return se3.exp(-J.T @ r / len(r)) @ T_WC


def _not_rigid(T_WC: Tensor, r: Tensor, J: Tensor) -> Tensor:
    xi = torch.linalg.solve(J.T @ J, -J.T @ r)
    step = torch.eye(4, dtype=T_WC.dtype)
    step[:3, :3] += se3.hat(xi[3:])
    step[:3, 3] = xi[:3]
    return step @ T_WC


def _as_next_pose(yours: Yours, T: Tensor, system: IcpSystem, step: Step) -> Any:
    """Yours with six rows r, J that have the sums J^T J and J^T r of all pixels: J = L^T and r =
    L^-1 b for H = L L^T.

    Where the scene leaves a direction open, the reference takes the step.
    """
    H = system.H.cpu()
    b = system.b.cpu()
    L, info = torch.linalg.cholesky_ex(H)
    if step.degenerate or info:
        return NotImplemented
    r = torch.linalg.solve_triangular(L, b[:, None], upper=False)[:, 0]
    return yours(T, r, L.T, gives={"the pose": T})


@exercise(
    chapter=8,
    difficulty=3,
    minutes=12,
    solution=_gauss_newton,
    becomes=Becomes("next_pose", _as_next_pose),
    hints=(
        "Minimise |r + J xi|^2: set the derivative to zero, J^T J xi = -J^T r.",
        "torch.linalg.solve(J.T @ J, -J.T @ r). Then turn the twist into a motion with "
        "se3.exp(xi).",
        "The twist moved points that were already in the world: so the motion is multiplied from "
        "the left of T_WC.",
    ),
    wrong=(
        Wrong(_plus_sign, says="the step goes towards the surface"),
        Wrong(_gradient_descent, says="one step solves a small error"),
        Wrong(_right_side, says="the motion is in the world frame"),
        Wrong(_not_rigid, says="the result is a rigid motion"),
    ),
)
def gauss_newton(attempt: Attempt) -> None:
    """One Gauss-Newton step on the pose."""
    generator = torch.Generator().manual_seed(4)
    p_C = torch.randn(60, 3, generator=generator, dtype=torch.float64)
    n = torch.nn.functional.normalize(
        torch.randn(60, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    quarter = torch.eye(4, dtype=torch.float64)
    quarter[:3, :3] = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    quarter[:3, 3] = torch.tensor([0.5, 0.2, -0.3])

    def ask(case: str, true: Tensor, twist: list[float]) -> Tensor:
        q = se3.apply(true, p_C)
        start = se3.exp(torch.tensor(twist, dtype=torch.float64)) @ true
        r, J = _residual_and_jacobian(se3.apply(start, p_C), q, n)
        got = attempt.on(case)(start, r, J)
        attempt.holds(
            isinstance(got, Tensor) and got.shape == (4, 4),
            "it returns a pose",
            detail="expected a tensor [4, 4]",
        )
        return got

    eye = torch.eye(4, dtype=torch.float64)
    got = ask("60 points, 1 cm off along x", eye, [0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    attempt.holds(
        float(got[0, 3]) < 0.0101,
        "the step goes towards the surface",
        detail=f"x is {float(got[0, 3]):.4f} m",
    )
    attempt.close(
        got, eye, "one step solves a small error", tolerance=1e-4, why="solve J^T J xi = -J^T r"
    )
    got = ask(
        "a camera turned by 90 degrees, 1 cm off along x", quarter, [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]
    )
    attempt.close(
        got,
        quarter,
        "the motion is in the world frame",
        tolerance=1e-4,
        why="exp(xi) must be on the left",
    )
    R = ask(
        "the same, turned by 17 degrees",
        quarter,
        [0.0, 0.0, 0.0, 0.1, -0.2, 0.2],
    )[:3, :3]
    attempt.close(
        R @ R.T,
        torch.eye(3),
        "the result is a rigid motion",
        tolerance=1e-6,
        why="use se3.exp, not I + hat",
    )


def _predict(T_before: Tensor, T_last: Tensor) -> Tensor:
    return T_last @ se3.inverse(T_before) @ T_last


def _same_again(T_before: Tensor, T_last: Tensor) -> Tensor:
    return T_last


def _linear(T_before: Tensor, T_last: Tensor) -> Tensor:
    return 2 * T_last - T_before


def _world_motion(T_before: Tensor, T_last: Tensor) -> Tensor:
    T = T_last.clone()
    T[:3, :3] = T_last[:3, :3] @ T_before[:3, :3].T @ T_last[:3, :3]
    T[:3, 3] = 2 * T_last[:3, 3] - T_before[:3, 3]
    return T


def _as_constant_velocity(
    yours: Yours, T_before: Tensor, T_last: Tensor, ratio: float = 1.0
) -> Tensor:
    """The motion from the last pose to that of yours, in proportion to time where frames are not
    evenly spaced."""
    T_next = yours(T_before, T_last, gives={"the pose": T_last})
    return T_next if ratio == 1 else T_last @ se3.exp(ratio * se3.log(se3.inverse(T_last) @ T_next))


@exercise(
    chapter=8,
    difficulty=2,
    minutes=6,
    solution=_predict,
    becomes=Becomes("constant_velocity", _as_constant_velocity),
    hints=(
        "The motion between the two frames, in the camera's own axes: inverse(T_before) @ T_last.",
        "Do the same motion once more, from where the camera is now, in its own axes: on the "
        "right.",
        "Poses cannot be added: 2 T_last - T_before has a rotation part that is not a rotation.",
    ),
    wrong=(
        Wrong(_same_again, says="a constant motion continues"),
        Wrong(_linear, says="the result is a rigid motion"),
        Wrong(_world_motion, says="a motion along a curve continues along the curve"),
    ),
)
def predict(attempt: Attempt) -> None:
    """Where will the camera be next, if its motion continues?"""
    eye = torch.eye(4, dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[2, 3] = 0.1
    got = attempt.on("10 cm forward since the frame before")(eye, motion)
    attempt.holds(
        isinstance(got, Tensor) and got.shape == (4, 4),
        "it returns a pose",
        detail="expected a tensor [4, 4]",
    )
    attempt.close(got[:3, 3], [0.0, 0.0, 0.2], "a constant motion continues")
    curve = se3.exp(torch.tensor([0.0, 0.0, 0.1, 0.0, 0.3, 0.0], dtype=torch.float64))
    got = attempt.on("forward and turning by 17 degrees")(curve, curve @ curve)
    R = got[:3, :3]
    attempt.close(R @ R.T, torch.eye(3), "the result is a rigid motion", tolerance=1e-6)
    attempt.close(
        got,
        curve @ curve @ curve,
        "a motion along a curve continues along the curve",
        tolerance=1e-6,
    )
    attempt.on("the same motion, from a camera that has turned and moved before")
    start = se3.exp(torch.tensor([0.4, -0.3, 0.2, 0.5, -0.2, 0.7], dtype=torch.float64))
    got = attempt(start @ curve, start @ curve @ curve)
    prop = "the motion continues in the camera's own axes, wherever the camera is"
    attempt.close(
        got,
        start @ curve @ curve @ curve,
        prop,
        tolerance=1e-6,
        why="inverse(T_before) @ T_last, on the right",
    )


def _spread(poses: Tensor, T_loop: Tensor) -> Tensor:
    change = se3.log(T_loop @ se3.inverse(poses[-1]))
    share = torch.linspace(0, 1, len(poses)).to(poses)
    return se3.exp(share[:, None] * change) @ poses


def _all_of_it(poses: Tensor, T_loop: Tensor) -> Tensor:
    return T_loop @ se3.inverse(poses[-1]) @ poses


def _only_the_end(poses: Tensor, T_loop: Tensor) -> Tensor:
    return torch.cat([poses[:-1], T_loop[None]])


def _wrong_way(poses: Tensor, T_loop: Tensor) -> Tensor:
    change = se3.log(poses[-1] @ se3.inverse(T_loop))
    share = torch.linspace(0, 1, len(poses)).to(poses)
    return se3.exp(share[:, None] * change) @ poses


def _linear_blend(poses: Tensor, T_loop: Tensor) -> Tensor:
    share = torch.linspace(0, 1, len(poses)).to(poses)[:, None, None]
    eye = torch.eye(4).to(poses)
    return (eye + share * (T_loop @ se3.inverse(poses[-1]) - eye)) @ poses


@exercise(
    chapter=8,
    difficulty=4,
    minutes=15,
    solution=_spread,
    hints=(
        "What takes the last pose to where the loop says it is? change = T_loop @ "
        "inverse(poses[-1]), on the left.",
        "Pose k gets the share k / (N - 1) of it: none at the start, all at the end.",
        "A share of a motion is exp(share * log(change)); a matrix cannot be blended. se3.exp "
        "takes a batch.",
    ),
    wrong=(
        Wrong(_all_of_it, says="the first pose stays"),
        Wrong(_wrong_way, says="the last pose is where the loop says"),
        Wrong(_only_the_end, says="the correction grows evenly along the path"),
        Wrong(_linear_blend, says="every pose stays rigid"),
    ),
)
def spread_correction(attempt: Attempt) -> None:
    """Spread the correction found by a loop closure over the path before it."""
    n = 5
    path = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    path[:, 0, 3] = torch.arange(n)
    end = path[-1].clone()
    end[1, 3] = 0.4
    got = attempt.on("five poses along x; the loop says the last one is 40 cm farther left")(
        path, end
    )
    attempt.holds(
        isinstance(got, Tensor) and got.shape == (n, 4, 4),
        "it returns N poses",
        detail="expected [N, 4, 4]",
    )
    attempt.close(got[0], path[0], "the first pose stays", tolerance=1e-6)
    attempt.close(got[-1], end, "the last pose is where the loop says", tolerance=1e-6)
    attempt.close(
        got[:, 1, 3],
        [0.0, 0.1, 0.2, 0.3, 0.4],
        "the correction grows evenly along the path",
        tolerance=1e-6,
    )
    T_end = end.clone()
    T_end[:3, :3] = se3.exp(torch.tensor([0.0, 0, 0, 0, 0, 1.2], dtype=torch.float64))[:3, :3]
    got = attempt.on("the same, and it has turned by 69 degrees")(path, T_end)
    R = got[:, :3, :3]
    eye = torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
    attempt.close(
        R @ R.transpose(1, 2),
        eye,
        "every pose stays rigid",
        tolerance=1e-6,
        why="exp(share * log(change))",
    )
    half = float(se3.rotation_angle(R[2]))
    attempt.close(half, 0.6, "halfway along the path it is half the turn", tolerance=1e-6)
    attempt.on("seven poses along a curve, and a loop that turns and moves the last one")
    curve = se3.exp(
        torch.linspace(0, 1, 7, dtype=torch.float64)[:, None]
        * torch.tensor([1.0, 0, 2, 0.3, 0.9, 0]).double()
    )
    loop = se3.exp(torch.tensor([0.1, 0.0, -0.1, 0.2, 0.0, 0.1], dtype=torch.float64)) @ curve[-1]
    prop = "each pose is moved by its share of the change, in the world's axes"
    why = (
        "change = T_loop @ inverse(poses[-1]), and exp(share * log(change)) is on the left of "
        "each pose"
    )
    attempt.close(
        attempt(curve, loop),
        _spread(curve, loop),
        prop,
        tolerance=1e-6,
        why=why,
    )
