"""A hash of everything that a run reads of a sequence, to recognise the same data (``hashes.file_hashes``)."""

import hashlib
from typing import Any

import torch

from ..files import file_hashes
from .adjust.repair import RepairedSequence
from .adjust.select import OpenedSequence, SequenceView
from .recorded.recorded_sequence import RecordedSequence
from .sequence import SequenceError


def sequence_fingerprint(sequence: OpenedSequence) -> str:
    """A hash of an open sequence: frames to map, frames held out, camera, poses, and the content of all their images.

    Of a recording on disk the files are hashed, those with poses and intrinsics too; of any other sequence the pixels
    of every frame, unless its source has a ``content``, a text that decides its frames (the built-in room).
    """
    digest = hashlib.blake2b(digest_size=16)
    views = (sequence.mapping, sequence.held_out)
    for view in views:
        digest.update(repr((view.positions, view.camera, view.depth_min_m, view.depth_max_m)).encode())
        for i in range(len(view)):
            digest.update(_pose_bytes(view, i))
    source = sequence.source
    if isinstance(source, RepairedSequence):
        digest.update(repr(source.repair).encode())
        source = source.source
    if isinstance(source, RecordedSequence):
        stored = (source.depth_scale, source.depth_invalid, source.stored_size, source.fit_sizes)
        digest.update(repr((stored, list(data_files(sequence).values()))).encode())
        if source.rectify is not None:  # what it does to the images shows in one of them
            _add_pixels(digest, sequence.mapping, at_most=1)
    elif content := getattr(source, "content", ""):
        digest.update(content.encode())
    else:
        for view in views:
            _add_pixels(digest, view)
    return digest.hexdigest()


def data_files(sequence: OpenedSequence) -> dict[str, str]:
    """Path -> hash of each file that a run on ``sequence`` reads; empty for a sequence that is not on disk."""
    source = sequence.source.source if isinstance(sequence.source, RepairedSequence) else sequence.source
    if not isinstance(source, RecordedSequence):
        return {}
    positions = [*sequence.mapping.positions, *sequence.held_out.positions]
    images = [file for i in positions for file in (source.rgb_files[i], source.depth_files[i])]
    return file_hashes([*source.read_from, *images])


def _pose_bytes(view: SequenceView, i: int) -> bytes:
    try:
        return view.pose(i).to("cpu", torch.float64).contiguous().numpy().tobytes()
    except SequenceError:
        return b"no pose"


def _add_pixels(digest: Any, view: SequenceView, at_most: int = -1) -> None:
    """Add the images of the first ``at_most`` frames that can be read; of all by default."""
    for i in range(len(view)):
        try:
            frame = view[i]
        except SequenceError:
            digest.update(b"no frame")
            continue
        for pixels in (frame.colour, frame.depth_m):
            digest.update(pixels.cpu().contiguous().numpy().tobytes())
        at_most -= 1
        if at_most == 0:
            return
