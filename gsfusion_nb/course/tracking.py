"""Exercises of chapter 8: residual, Jacobian and step of ICP."""

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
    attempt.rigid(R, "the result is a rigid motion", why="use se3.exp, not I + hat")
