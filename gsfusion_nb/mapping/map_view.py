"""What every mapper shows of its map: the surface as a camera sees it, and the parts with their sizes."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class SurfaceImage(Protocol):
    """The surface of a map as a camera sees it."""

    @property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """Colours of the surface, 0..1."""
        ...

    @property
    def depth_m(self) -> Float[Tensor, "H W"]:
        """z-depth, metres; 0 where there is none."""
        ...

    @property
    def normal_W(self) -> Float[Tensor, "H W 3"]:
        """Unit normal towards the camera, world frame; 0 where it is not known."""
        ...


@dataclass(frozen=True, kw_only=True)
class MapPart:
    """One kind of elements of a map."""

    name: str
    """In the plural, as in "12,000 Gaussians"."""
    count: int
    size_bytes: int
    """Their memory, bytes."""
