"""Counting the seeds that the camera cannot see: most often the sign of a pose that was not applied."""

from collections.abc import Callable
from typing import Any

import torch

from ..geometry import project, se3
from ..types import Camera


class OutOfView:
    """An observer (``observing``) of a mapper that counts the seeds of its rule outside of the frame's view."""

    def __init__(self):
        self._n = 0
        self._behind, self._outside = torch.zeros(2, dtype=torch.long).unbind()

    def __call__(self, name: str, f: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Do the call; if a rule is asked, count its seeds."""
        result = f(*args, **kwargs)
        if name == "apply_rule" and len(result):
            _, context, *_ = args
            frame = context.frame
            xyz_C = se3.apply(se3.inverse(frame.T_WC), result.xyz_W)
            behind = xyz_C[:, 2] <= 0
            self._n += len(result)
            self._behind = self._behind.to(behind.device) + behind.sum()
            self._outside = self._outside.to(behind.device) + (behind | ~_in_image(frame.camera, xyz_C)).sum()
        return result

    def note(self) -> list[str]:
        """A sentence about them, if there are any."""
        behind, outside = int(self._behind), int(self._outside)
        if not outside:
            return []
        text = f"{outside:,} of {self._n:,} seeds lay outside the view of the camera"
        return [f"{text}, {behind:,} of them behind it" if behind else text]


def _in_image(camera: Camera, xyz_C: torch.Tensor) -> torch.Tensor:
    """Whether points project into the image, or up to a pixel beside it."""
    u, v = project(camera, xyz_C).unbind(-1)
    return (u >= -1) & (u <= camera.width + 1) & (v >= -1) & (v <= camera.height + 1)
