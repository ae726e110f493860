"""Exercises of chapter 8: prediction of the next pose, and the correction after a loop closure."""

import torch
from torch import Tensor

from ..geometry import se3
from .exercise import Attempt, Becomes, Wrong, Yours, exercise


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
    attempt.rigid(got[:3, :3], "the result is a rigid motion")
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
