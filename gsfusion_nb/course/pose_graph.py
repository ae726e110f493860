"""Exercises of chapter 8: a pose graph, from the error of one measured relative pose to a
Gauss-Newton step."""

import torch
from torch import Tensor

from ..geometry import se3
from ..tracking import pose_graph_step, relative_pose_error
from .exercise import Attempt, Becomes, Wrong, Yours, exercise

F64 = torch.float64


def _relative_error(
    T_i: Tensor,
    T_j: Tensor,
    T_ij: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    e = se3.log(se3.inverse(T_ij) @ se3.inverse(T_i) @ T_j)
    return e, -se3.adjoint(se3.inverse(T_j) @ T_i), torch.eye(6).to(e)


def _measured_minus_poses(
    T_i: Tensor,
    T_j: Tensor,
    T_ij: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    e, J_i, J_j = _relative_error(T_i, T_j, T_ij)
    return -e, -J_i, -J_j


def _in_the_world(
    T_i: Tensor,
    T_j: Tensor,
    T_ij: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    _, J_i, J_j = _relative_error(T_i, T_j, T_ij)
    return se3.log(T_j @ se3.inverse(T_i @ T_ij)), J_i, J_j


def _both_plus(
    T_i: Tensor,
    T_j: Tensor,
    T_ij: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    e, J_i, J_j = _relative_error(T_i, T_j, T_ij)
    return e, -J_i, J_j


def _as_relative_pose_error(
    yours: Yours, T_i: Tensor, T_j: Tensor, T_ij: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Yours for each edge."""
    ends = [T.expand(T_ij.shape).reshape(-1, 4, 4) for T in (T_i, T_j, T_ij)]
    shape = T_ij.shape[:-2]
    J = torch.eye(6).to(T_ij)
    derivatives = {"e": J[0], "J_i": J, "J_j": J}
    rows = [yours(*edge, gives=derivatives) for edge in zip(*ends, strict=True)]
    if not rows:
        return T_ij.new_zeros(*shape, 6), T_ij.new_zeros(*shape, 6, 6), T_ij.new_zeros(*shape, 6, 6)
    e, J_i, J_j = (torch.stack(column) for column in zip(*rows, strict=True))
    return e.view(*shape, 6), J_i.view(*shape, 6, 6), J_j.view(*shape, 6, 6)


@exercise(
    chapter=8,
    difficulty=4,
    minutes=15,
    solution=_relative_error,
    becomes=Becomes("relative_pose_error", _as_relative_pose_error),
    hints=(
        "The poses say that camera j is at T_i^-1 T_j, seen from camera i. If this equals T_ij, "
        "then T_ij^-1 T_i^-1 T_j is the identity, and its log is zero.",
        "T_j exp(xi_j) stands at the right end of that product: a small e becomes e + xi_j, so J_j "
        "is the identity.",
        "T_i exp(xi_i) stands in the middle, as exp(-xi_i) T_i^-1 T_j. Move it to the right end: "
        "exp(-xi_i) M = M exp(-Ad(M^-1) xi_i) with M = T_i^-1 T_j. So J_i = -Ad(T_j^-1 T_i), "
        "se3.adjoint.",
    ),
    wrong=(
        Wrong(_measured_minus_poses, says="e points from where j was measured to where it is"),
        Wrong(_in_the_world, says="along the axes of camera j"),
        Wrong(_both_plus, says="J_i is the derivative of e with respect to xi_i"),
    ),
)
def relative_error(attempt: Attempt) -> None:
    """Error of a measured relative pose, and its derivatives by the poses at both ends."""
    names = ("e", "J_i", "J_j")
    generator = torch.Generator().manual_seed(8)
    T_i, T_j = se3.exp(0.6 * torch.randn(2, 6, generator=generator, dtype=F64))
    T_ij = se3.inverse(T_i) @ T_j
    case = no_error = (
        "two turned cameras, and the relative pose between them measured without error"
    )
    e, J_i, J_j = attempt.unpack(attempt.on(case)(T_i, T_j, T_ij), names)
    attempt.close(e, torch.zeros(6), "a perfect measurement has no error", tolerance=1e-6)
    twist = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.05], dtype=F64)
    attempt.on(
        "the same cameras; the measured pose of j lies 10 cm farther left in j's own axes, turned "
        "by 3 degrees"
    )
    e_off = attempt.unpack(attempt(T_i, T_j, T_ij @ se3.exp(-twist)), names)[0]
    backwards = _is_close(e_off, -twist)
    attempt.holds(
        not backwards,
        "e points from where j was measured to where it is",
        detail="the sign is turned round",
    )
    attempt.close(
        e_off, twist, "e is a twist along the axes of camera j, translation first", tolerance=1e-5
    )
    attempt.on(no_error)
    for J in (J_i, J_j):
        six = tuple(getattr(J, "shape", ())) == (6, 6)
        attempt.holds(six, "J_i and J_j are 6 x 6", detail="expected two tensors [6, 6]")
    for name, J, end in (("J_j", J_j, 1), ("J_i", J_i, 0)):
        prop = f"{name} is the derivative of e with respect to xi_{name[-1]}"
        attempt.close(
            J,
            _differences(T_i, T_j, T_ij, end),
            prop,
            tolerance=1e-4,
            why=f"T_{name[-1]} becomes T_{name[-1]} exp(xi), and e is differentiated by xi",
        )


def _is_close(value: object, reference: Tensor) -> bool:
    number = torch.as_tensor(value)
    return number.shape == reference.shape and bool((number - reference).abs().max() < 1e-5)


def _differences(
    T_i: Tensor,
    T_j: Tensor,
    T_ij: Tensor,
    end: int,
    step: float = 1e-6,
) -> Tensor:
    """Derivative of e by the twist of T_i (``end`` 0) or T_j (1), by central differences. [6,
    6]"""
    columns = []
    for k in range(6):
        xi = torch.zeros(6, dtype=F64)
        xi[k] = step
        ends = [
            (T_i @ se3.exp(s * xi), T_j) if end == 0 else (T_i, T_j @ se3.exp(s * xi))
            for s in (1.0, -1.0)
        ]
        e_plus, e_minus = (_relative_error(a, b, T_ij)[0] for a, b in ends)
        columns.append((e_plus - e_minus) / (2 * step))
    return torch.stack(columns, dim=1)


def _graph_step(
    poses: Tensor,
    i: Tensor,
    j: Tensor,
    e: Tensor,
    J_i: Tensor,
    J_j: Tensor,
    information: Tensor,
) -> Tensor:
    n = 6 * len(poses)
    H = torch.zeros(n, n).to(poses)
    b = torch.zeros(n).to(poses)
    for k in range(len(e)):
        ends = ((6 * int(i[k]), J_i[k]), (6 * int(j[k]), J_j[k]))
        for a, J_a in ends:
            b[a : a + 6] += J_a.T @ information[k] @ e[k]
            for c, J_c in ends:
                H[a : a + 6, c : c + 6] += J_a.T @ information[k] @ J_c
    xi = torch.zeros_like(b)
    xi[6:] = torch.linalg.solve(H[6:, 6:], -b[6:])
    return poses @ se3.exp(xi.view(-1, 6))


def _equally_sure(poses, i, j, e, J_i, J_j, information):
    return _graph_step(
        poses,
        i,
        j,
        e,
        J_i,
        J_j,
        torch.eye(6).to(poses).expand(len(e), 6, 6),
    )


def _step_upwards(poses, i, j, e, J_i, J_j, information):
    return _graph_step(poses, i, j, -e, J_i, J_j, information)


def _everything_moves(poses, i, j, e, J_i, J_j, information):
    step = _graph_step(poses, i, j, e, J_i, J_j, information)
    return se3.exp(torch.tensor([0.1, 0, 0, 0, 0, 0], dtype=poses.dtype)) @ step


def _from_the_left(poses, i, j, e, J_i, J_j, information):
    step = se3.log(se3.inverse(poses) @ _graph_step(poses, i, j, e, J_i, J_j, information))
    return se3.exp(step) @ poses


def _as_pose_graph_step(yours: Yours, T_WC: Tensor, *graph: Tensor) -> Tensor:
    """Yours with the same arguments."""
    return yours(T_WC, *graph, gives={"the poses": T_WC})


@exercise(
    chapter=8,
    difficulty=4,
    minutes=20,
    solution=_graph_step,
    becomes=Becomes("pose_graph_step", _as_pose_graph_step),
    hints=(
        "It is the step of exercise 8.2 with more unknowns: six for each pose. An edge depends on "
        "two poses only, so it adds to two parts of b and to four blocks of H.",
        "b[a] += J_a^T Omega e and H[a, c] += J_a^T Omega J_c, for a and c in {i, j}.",
        "Without a fixed pose all poses could move together: leave out the rows and columns of "
        "pose 0 and solve "
        "H[6:, 6:] xi = -b[6:]. Then poses[k] @ se3.exp(xi_k), with zeros for pose 0.",
    ),
    wrong=(
        Wrong(_everything_moves, says="the first pose stays"),
        Wrong(_step_upwards, says="a contradiction is shared"),
        Wrong(_equally_sure, says="the surer measurement counts more"),
        Wrong(_from_the_left, says="in the camera's own axes"),
    ),
)
def graph_step(attempt: Attempt) -> None:
    """One Gauss-Newton step on all poses of a pose graph."""
    line = torch.eye(4, dtype=F64).repeat(3, 1, 1)
    line[:, 0, 3] = torch.tensor([0.0, 1.0, 2.0])
    i = torch.tensor([0, 1, 0])
    j = torch.tensor([1, 2, 2])
    T_ij = torch.eye(4, dtype=F64).repeat(3, 1, 1)
    T_ij[:, 0, 3] = torch.tensor([1.0, 1.0, 2.3])
    even = _ones(3)
    case = "three poses 1 m apart, as measured; a loop says that the last is 2.3 m from the first"
    got = _asked(attempt, case, line, i, j, T_ij, even)
    attempt.close(
        got[0],
        line[0],
        "the first pose stays",
        tolerance=1e-6,
        why="leave its rows and columns out of H",
    )
    prop = "a contradiction is shared by all edges of the loop"
    attempt.close(
        got[:, 0, 3],
        [0.0, 1.1, 2.2],
        prop,
        tolerance=1e-4,
        why="each of the three edges takes 10 cm of it",
    )
    sure = even * torch.tensor([1.0, 1.0, 1000.0], dtype=F64)[:, None, None]
    got = _asked(
        attempt, "the same, and the loop is a thousand times as certain", line, i, j, T_ij, sure
    )
    prop = "the surer measurement counts more"
    attempt.close(
        got[:, 0, 3],
        [0.0, 1.15, 2.3],
        prop,
        tolerance=1e-3,
        why="Omega stands in H and in b",
    )
    generator = torch.Generator().manual_seed(9)
    poses = se3.exp(torch.randn(4, 6, generator=generator, dtype=F64))
    i = torch.tensor([0, 1, 2, 0, 3])
    j = torch.tensor([1, 2, 3, 3, 1])
    noise = se3.exp(0.05 * torch.randn(5, 6, generator=generator, dtype=F64))
    T_ij = se3.inverse(poses[i]) @ poses[j] @ noise
    case = "four turned poses and five edges, one of them from a later pose to an earlier one"
    got = _asked(attempt, case, poses, i, j, T_ij, _ones(5))
    R = got[:, :3, :3]
    attempt.close(
        R @ R.mT,
        torch.eye(3).expand(4, 3, 3),
        "every pose stays rigid",
        tolerance=1e-6,
        why="use se3.exp",
    )
    reference = pose_graph_step(
        poses,
        i,
        j,
        *relative_pose_error(poses[i], poses[j], T_ij),
        _ones(5),
    )
    prop = "the step is in the camera's own axes: T_k exp(xi_k)"
    attempt.close(
        got,
        reference,
        prop,
        tolerance=1e-5,
        why="it is that of gsfusion_nb.tracking.pose_graph_step",
    )


def _ones(n: int) -> Tensor:
    return torch.eye(6, dtype=F64).repeat(n, 1, 1)


def _asked(
    attempt: Attempt,
    case: str,
    poses: Tensor,
    i: Tensor,
    j: Tensor,
    T_ij: Tensor,
    weight: Tensor,
) -> Tensor:
    """The learner's poses after one step."""
    got = attempt.on(case)(
        poses,
        i,
        j,
        *relative_pose_error(poses[i], poses[j], T_ij),
        weight,
    )
    right = isinstance(got, Tensor) and got.shape == poses.shape
    attempt.holds(right, "it returns all poses", detail=f"expected a tensor {list(poses.shape)}")
    return got
