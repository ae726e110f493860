"""The camera-to-world pose of every mapped frame, and its later corrections."""

import bisect
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..geometry import se3
from ..types import Frame

_BLOCK = 1024
"""Number of poses that are stored in one tensor."""


class Trajectory:
    """One pose per mapped frame, on the CPU, with the number that the frame has in its source.

    Poses change after they were added: a loop that closes moves all of them (``move``), and
    pictures may refine single ones (``refine``), which the frames between follow (``follow``).
    """

    def __init__(self):
        self.poses: list[Float[Tensor, "4 4"]] = []
        """Camera-to-world pose of every mapped frame; corrected when a loop closes."""
        self.given_poses: list[Float[Tensor, "4 4"]] = []
        """The same poses before pictures refined them; the same tensors where none did."""
        self.frame_indices: list[int] = []
        """Number of each of these frames in its source, increasing."""
        self._block = torch.zeros(_BLOCK, 4, 4)
        self._n_in_blocks = 0

    def begin_with(self, poses: Iterable[Float[Tensor, "4 4"]], frame_indices: list[int]) -> None:
        """Hold these frames, and no others."""
        self.poses = [self._in_block(T_WC.cpu()) for T_WC in poses]
        self.given_poses = list(self.poses)
        self.frame_indices = list(frame_indices)

    def add(self, frame: Frame) -> None:
        """Add a mapped frame."""
        self.poses.append(self._in_block(frame.T_WC_cpu))
        self.given_poses.append(self.poses[-1])
        self.frame_indices.append(frame.index)

    def move(self, moves: Float[Tensor, "N 4 4"]) -> None:
        """Move each frame by a transform in the world, refined frames with what refined them."""
        old_poses = self.poses
        self.poses = [T @ pose for T, pose in zip(moves, old_poses, strict=True)]
        pairs = zip(moves, self.poses, old_poses, self.given_poses, strict=True)
        self.given_poses = [
            T_new if T_given is T_old else T @ T_given for T, T_new, T_old, T_given in pairs
        ]

    @property
    def is_refined(self) -> bool:
        """Whether pictures have moved a pose away from the given one (``optim.refine_poses``)."""
        pairs = zip(self.poses, self.given_poses, strict=False)
        return any(T_WC is not T_given for T_WC, T_given in pairs)

    def refine(self, row: int, T_WC: Float[Tensor, "4 4"]) -> None:
        """Give the mapped frame with this number another pose; ``given_poses`` keeps the one
        before."""
        if self.poses[row] is self.given_poses[row]:
            self.poses[row] = self._in_block(self.given_poses[row])
        self.poses[row].copy_(T_WC)

    def undo_of_refinement(self) -> Callable[[], None]:
        """A function that undoes what ``refine`` and ``follow`` change from now on."""
        poses = list(self.poses)
        values = [pose.clone() for pose in poses]

        def undo() -> None:
            self.poses = list(poses)
            for pose, value in zip(self.poses, values, strict=True):
                pose.copy_(value)

        return undo

    def follow(self, rows: list[int]) -> None:
        """Refine the frames between those with the numbers ``rows``, which were refined: each by
        what they were."""
        indices = torch.tensor([self.frame_indices[row] for row in rows])
        twists = self._twists(rows)
        for row in set(range(len(self.poses))) - set(rows):
            xi = between(indices, twists, self.frame_indices[row])
            self.refine(
                row,
                (self.given_poses[row].double() @ se3.exp(xi)).float(),
            )

    def refined_pose(
        self,
        index: int,
        T_WC: Float[Tensor, "4 4"],
    ) -> Float[Tensor, "4 4"]:
        """The given pose of any frame of the source, moved as the mapped frames before and after it
        were refined."""
        if not self.is_refined:
            return T_WC
        twists = self._twists(range(len(self.poses)))
        xi = between(torch.tensor(self.frame_indices), twists, index)
        return (T_WC.double() @ se3.exp(xi)).to(T_WC)

    def pose_near(self, index: int) -> Float[Tensor, "4 4"]:
        """A pose between those of the mapped frames before and after any frame of the source, or
        the first or last."""
        poses = torch.stack(self.poses).double()
        row = bisect.bisect(self.frame_indices, index)
        if row in (0, len(poses)):
            return poses[min(row, len(poses) - 1)]
        first, last = self.frame_indices[row - 1 : row + 1]
        step = se3.log(se3.inverse(poses[row - 1]) @ poses[row])
        return poses[row - 1] @ se3.exp((index - first) / (last - first) * step)

    def _twists(self, rows: Iterable[int]) -> Float[Tensor, "R 6"]:
        """How far some frames were refined, each in its camera's frame."""
        rows = list(rows)
        T_given = torch.stack([self.given_poses[row] for row in rows]).double()
        T_refined = torch.stack([self.poses[row] for row in rows]).double()
        return se3.log(se3.inverse(T_given) @ T_refined)

    def _in_block(self, T_WC: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """A copy of the pose inside a larger tensor.

        A small tensor of its own per frame, between the large ones of the frames, would prevent the
        allocator from reusing the frames' memory: measured, 50 to 220 kB lost per frame of 160x120.
        """
        n = self._n_in_blocks % _BLOCK
        if n == 0:
            self._block = torch.zeros(_BLOCK, 4, 4)
        self._n_in_blocks += 1
        return self._block[n].copy_(T_WC)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue."""
        return {
            "poses": torch.stack(self.poses) if self.poses else torch.zeros(0, 4, 4),
            "given": torch.stack(self.given_poses) if self.is_refined else None,
            "frame_indices": torch.tensor(self.frame_indices, dtype=torch.int64),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.begin_with(state["poses"], state["frame_indices"].tolist())
        if state["given"] is not None:
            self.given_poses = [self._in_block(T_WC) for T_WC in state["given"].cpu()]


def between(
    indices: Int[Tensor, " R"], values: Float[Tensor, "R D"], index: int
) -> Float[Tensor, " D"]:
    """Values at increasing numbers of frames, interpolated for another frame; outside of them the
    first or last."""
    row = int(torch.searchsorted(indices, index).clamp(1, max(len(indices) - 1, 1)))
    if len(indices) == 1:
        return values[0]
    first = int(indices[row - 1])
    last = int(indices[row])
    share = min(max((index - first) / max(last - first, 1), 0.0), 1.0)
    return (1 - share) * values[row - 1] + share * values[row]
