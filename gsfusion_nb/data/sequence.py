"""The protocol of sequences."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from ..types import Camera, Frame


@runtime_checkable
class Sequence(Protocol):
    """Posed RGB-D frames in order. Anything with these members can be mapped; no base class is
    needed.

    ``sequence[i]`` decodes frame ``i`` and raises ``IndexError`` past the end, so
    ``for frame in sequence`` works.
    """

    @property
    def name(self) -> str:
        """Short name, for titles and folders."""
        ...

    @property
    def camera(self) -> Camera:
        """The one camera of all frames."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, i: int) -> Frame: ...

    def pose(self, i: int) -> Float[Tensor, "4 4"]:
        """Camera-to-world pose of frame ``i``, the same as ``sequence[i].T_WC``, without decoding
        images."""
        ...


def position(i: int, length: int) -> int:
    """Index ``i`` of a sequence of ``length`` frames as a number from 0, counting from the end when
    negative.

    Raises:
        IndexError: past either end.
    """
    if not -length <= i < length:
        raise IndexError(f"frame {i} of a sequence of {length}")
    return i % length
