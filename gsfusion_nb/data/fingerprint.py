"""A hash of the content of an open sequence, by which another one is recognised."""

import hashlib

import torch

from .adjust.select import OpenedSequence, SequenceView
from .sequence import SequenceError


def sequence_fingerprint(sequence: OpenedSequence) -> str:
    """A hash of an open sequence: frames to map, frames held out, camera, poses, and the pixels of three frames."""
    digest = hashlib.blake2b(digest_size=16)
    for view in (sequence.mapping, sequence.held_out):
        digest.update(repr((view.positions, view.camera, view.depth_min_m, view.depth_max_m)).encode())
        for i in range(len(view)):
            digest.update(_pose_bytes(view, i))
    n = len(sequence.mapping)
    for i in sorted({0, n // 2, n - 1} & set(range(n))):
        try:
            frame = sequence.mapping[i]
        except SequenceError:
            continue
        for pixels in (frame.colour, frame.depth_m):
            digest.update(pixels.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _pose_bytes(view: SequenceView, i: int) -> bytes:
    try:
        return view.pose(i).to("cpu", torch.float64).contiguous().numpy().tobytes()
    except SequenceError:
        return b"no pose"
