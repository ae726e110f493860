"""Images that repeat the one before: suspected on the small copies, verified on the images themselves."""

import torch

from ...data.sequence import BadFrameError, Sequence
from .frame_to_frame import OverFrames
from .sample import Sample


def same_images(sequence: Sequence, sample: Sample, over: OverFrames) -> dict[int, str]:
    """Frame number -> "colour", "depth" or "both", where every pixel is that of the frame before.

    Only frames whose small copies are the same are read again.
    """
    found = {}
    places = [f.place for f in sample.frames]
    for i, suspect in enumerate(over.same_colour | over.same_depth):
        if not suspect or places[i] + 1 not in sample.by_place:
            continue
        try:
            a, b = sequence[places[i]], sequence[places[i] + 1]
        except BadFrameError:
            continue
        colour, depth = torch.equal(a.rgb_u8, b.rgb_u8), torch.equal(a.depth_m, b.depth_m)
        if colour or depth:
            found[b.index] = "both" if colour and depth else "colour" if colour else "depth"
    return found
