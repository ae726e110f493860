"""Frames of a run's sequence at their poses in its map, and the poses of the data to compare with."""

import dataclasses
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from ..data import SequenceView
from ..errors import SequenceError
from ..geometry import se3
from ..mapping.localiser import Localiser
from ..types import Frame


def has_poses(view: SequenceView) -> bool:
    """Whether the data came with poses."""
    return getattr(view.source, "has_poses", True)


def readable_frames(view: SequenceView) -> Iterator[Frame]:
    """The frames of a view, without those that cannot be read (the run's warnings name them)."""
    for i in range(len(view)):
        try:
            yield view[i]
        except SequenceError:
            continue


def frames_in_map(view: SequenceView, localiser: Localiser, mapping: SequenceView) -> Iterator[Frame]:
    """The frames of a view at their poses in the map.

    With given poses, as they are. With tracked poses a mapped frame has its tracked pose, and any other frame is put
    relative to the nearest mapped frame n by the data's poses:  T_WC = T_WC(n) T_data(n)^-1 T_data. Without poses in
    the data only mapped frames have a pose in the map, and the others are left out.
    """
    if not localiser.is_tracking or not localiser.poses:
        yield from readable_frames(view)
        return
    mapped = torch.tensor(localiser.frame_indices)
    position = {index: i for i, index in enumerate(mapping.positions)}
    for frame in readable_frames(view):
        nearest = int((mapped - frame.index).abs().argmin())
        T_WC = localiser.poses[nearest]
        if int(mapped[nearest]) != frame.index:
            if not has_poses(mapping) or int(mapped[nearest]) not in position:
                continue
            T_data = mapping.pose(position[int(mapped[nearest])])
            T_WC = T_WC @ se3.inverse(T_data.to(T_WC)) @ frame.T_WC.to(T_WC)
        yield dataclasses.replace(frame, T_WC=T_WC)


def ground_truth_poses(localiser: Localiser, mapping: SequenceView) -> Float[Tensor, "N 4 4"] | None:
    """The data's poses of the mapped frames, or ``None`` if one is missing."""
    position = {index: i for i, index in enumerate(mapping.positions)}
    if not has_poses(mapping) or not position.keys() >= set(localiser.frame_indices):
        return None
    try:
        return torch.stack([mapping.pose(position[index]) for index in localiser.frame_indices])
    except SequenceError:
        return None
