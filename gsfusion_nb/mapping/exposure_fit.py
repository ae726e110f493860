"""Exposures that are fitted in the passes after the scan, so that the map has the mean brightness of the pictures."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import OptimConfig
from ..constants import SHOWN_ALPHA
from ..optim import Keyframe, KeyframeList, fit_gain
from ..types import RenderOutput
from .localiser import between


class ExposureFit:
    """The exposures of the keyframes by ``optim.fit_exposure``; they are stored with the keyframes."""

    def __init__(self, optim: OptimConfig):
        self.enabled = optim.fit_exposure

    def visit(
        self, keyframes: KeyframeList, keyframe: Keyframe, output: RenderOutput, target: Float[Tensor, "H W 3"]
    ) -> Float[Tensor, " 3"]:
        """The exposure with which a visited keyframe is compared now; that of its next visit is fitted to the map."""
        fitted = fit_gain(output.rgb, target, output.alpha >= SHOWN_ALPHA)
        keyframes.set_gain(keyframe.index, fitted)
        return fitted if keyframe.gain is None else keyframe.gain.to(fitted)

    def end_pass(self, keyframes: KeyframeList) -> None:
        """Divide all exposures by their geometric mean: a factor that all share belongs to the map."""
        gains = {k.index: k.gain.log() for k in keyframes if k.gain is not None}
        if gains:
            mean = torch.stack(list(gains.values())).mean(0)
            for index, gain in gains.items():
                keyframes.set_gain(index, (gain - mean).exp())


def exposure_between(fitted: Mapping[int, Float[Tensor, " 3"]], index: int) -> Float[Tensor, " 3"]:
    """The exposure of any frame of the source by those of the frames before and after it, interpolated in stops.

    Args:
        fitted: Number of a frame -> its exposure; at least one.
        index: Number of the frame; its own picture is not used.
    """
    indices = sorted(fitted)
    stops = torch.stack([fitted[i].double().log2().cpu() for i in indices])
    return between(torch.tensor(indices), stops, index).exp2().float()
