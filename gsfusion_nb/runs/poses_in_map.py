"""The poses that frames of the data have in the map of a run, and the frames with them."""

import dataclasses
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from ..data import FrameSubset
from ..data.adjust.repair import as_read
from ..errors import SequenceError
from ..geometry import se3
from ..mapping.localiser import Localiser
from ..types import Frame
from .mapping_run import has_poses


def readable_frames(view: FrameSubset) -> Iterator[Frame]:
    """The frames of a view, without those that cannot be read (the run's warnings name them)."""
    for i in range(len(view)):
        try:
            yield view[i]
        except SequenceError:
            continue


def poses_in_map(
    view: FrameSubset, localiser: Localiser, mapping: FrameSubset
) -> list[Float[Tensor, "4 4"] | None]:
    """The camera-to-world pose in the map of each frame of a view, or ``None``; no images are read.

    With given poses these are the poses of the data, and of mapped frames those that pictures
    refined (``optim.refine_poses``). With tracked poses a mapped frame has its tracked pose, and
    any other frame is placed relative to the nearest mapped frame n with the poses of the data:
    T_WC = T_WC(n) T_data(n)^-1 T_data. If the data has no poses, only mapped frames have a pose in
    the map.
    """
    trajectory = localiser.trajectory
    if not localiser.is_tracking or not trajectory.poses:
        mapped_at: dict[int, Tensor] = {}
        if trajectory.is_refined:
            mapped_at = dict(zip(trajectory.frame_indices, trajectory.poses, strict=True))
        return [mapped_at.get(index, _data_pose(view, i)) for i, index in enumerate(view.positions)]
    map_indices = torch.tensor(trajectory.frame_indices)
    position = {index: i for i, index in enumerate(mapping.positions)}
    poses = []
    for i, index in enumerate(view.positions):
        nearest = int((map_indices - index).abs().argmin())
        T_WC: Tensor | None = trajectory.poses[nearest]
        if int(map_indices[nearest]) != index:
            at = position.get(int(map_indices[nearest])) if has_poses(mapping) else None
            T_data_nearest = None if at is None else _data_pose(mapping, at)
            T_data = _data_pose(view, i)
            T_WC = (
                None
                if T_data_nearest is None or T_data is None
                else T_WC @ se3.inverse(T_data_nearest.to(T_WC)) @ T_data.to(T_WC)
            )
        poses.append(T_WC)
    return poses


def frames_in_map(view: FrameSubset, localiser: Localiser, mapping: FrameSubset) -> Iterator[Frame]:
    """The readable frames of a view with their ``poses_in_map``; frames without one are left
    out."""
    yield from frames_at(view, poses_in_map(view, localiser, mapping))


def frames_at(
    view: FrameSubset,
    poses: list[Float[Tensor, "4 4"] | None],
) -> Iterator[Frame]:
    """The readable frames of a view with other poses, one per frame; frames with ``None`` are left
    out."""
    positions = [i for i, T_WC in enumerate(poses) if T_WC is not None]
    for i in positions:
        try:
            frame = view[i]
        except SequenceError:
            continue
        yield dataclasses.replace(frame, T_WC=poses[i])


def _data_pose(view: FrameSubset, i: int) -> Float[Tensor, "4 4"] | None:
    """Pose of frame ``i`` of a view in the data; ``None`` if it cannot be used."""
    try:
        return view.pose(i)
    except SequenceError:
        return None


def ground_truth_poses(
    frame_indices: list[int], mapping: FrameSubset
) -> Float[Tensor, "N 4 4"] | None:
    """The true poses of frames where the source knows them (``true_pose``), otherwise
    those of the data; ``None`` if one is missing."""
    source = as_read(mapping.source)
    true_pose = getattr(source, "true_pose", None)
    if true_pose is not None:
        return torch.stack([true_pose(index) for index in frame_indices])
    position = {index: i for i, index in enumerate(mapping.positions)}
    if not has_poses(mapping) or not position.keys() >= set(frame_indices):
        return None
    try:
        return torch.stack([mapping.pose(position[index]) for index in frame_indices])
    except SequenceError:
        return None
