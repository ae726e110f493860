"""Whether the sizes and numbers of a run's parts belong together, after it was made of a state."""

from typing import Any

import torch

from ..checks import shown
from ..errors import SequenceError
from .sound_state import LARGEST_COUNT


def check_agreement(run: Any) -> None:
    """Check that the sizes and numbers of a run's parts belong together.

    Args:
        run: The ``MappingRun`` that was made of a state.

    Raises:
        SequenceError: with the two that do not.
    """
    mapper = run.mapper
    n = len(run.steps)
    trajectory = mapper.trajectory
    keyframes = mapper.keyframes
    sizes = {
        "frames of the mapper": mapper.n_frames,
        "poses": len(trajectory.poses),
        "given poses": len(trajectory.given_poses),
        "indices of frames": len(trajectory.frame_indices),
    }
    if len(set(sizes.values())) > 1:
        raise SequenceError(
            f"a state has {', '.join(f'{size} {name}' for name, size in sizes.items())}, not "
            "equally many"
        )
    if len(run.timestamps_s) != n or n > mapper.n_frames:
        raise SequenceError(
            f"a state has {n} reports of frames, {len(run.timestamps_s)} times and "
            f"{mapper.n_frames} mapped frames"
        )
    if run.next_position < n:
        raise SequenceError(
            f"a state has {n} reports of frames, but goes on at position {run.next_position}"
        )
    indices = trajectory.frame_indices
    n_earlier = mapper.n_frames - n
    if indices[n_earlier:] and min(indices[n_earlier:]) < 0:
        raise SequenceError(
            f"a mapped frame of a state has the index {min(indices[n_earlier:])}, expected at "
            "least 0"
        )
    numbers = [keyframe.index for keyframe in keyframes]
    if absent := {step.frame_index for step in run.steps if step.is_keyframe} - set(numbers):
        raise SequenceError(
            f"keyframe {min(absent)} of the reports of a state is not among its keyframes"
        )
    if strange := set(numbers) - set(indices):
        raise SequenceError(f"keyframe {min(strange)} of a state is not among its mapped frames")
    # else of two recordings, one by one
    if len(set(numbers)) < len(numbers) and len(set(indices)) == len(indices):
        raise SequenceError("a state has a keyframe twice")
    queue = mapper.passes.queue
    if len(set(queue)) < len(queue) or any(not 0 <= k < len(keyframes) for k in queue):
        raise SequenceError(
            f"the passes of a state wait for keyframes {shown(queue)}; it has {len(keyframes)}"
        )
    _check_rows(mapper.gaussians)


def _check_rows(model: Any) -> None:
    """Numbers of rows that are negative, or later than the present."""
    names = [
        name
        for name in model.columns
        if name in ("last_step", "birth_step", "birth_frame", "state")
    ]
    for name in names:
        column = model.columns[name]
        if not len(column):
            continue
        low, high = (int(x) for x in torch.aminmax(column))
        least, most = {"state": (0, 1), "birth_frame": (-1, LARGEST_COUNT)}.get(
            name, (0, model.clock.count)
        )
        if low < least or high > most:
            raise SequenceError(
                f"{name} of the Gaussians must be from {least} to {most}, got {low} to {high}"
            )
