"""Panel of GPS-SLAM's two parts: the coloured surface, and what the Gaussians add to it."""

from collections.abc import Mapping

from ...drawing.pictures import AnyImage, error_map, side_by_side, to_uint8
from .panel import Choice, Drawn, Panel


def surface_panel(
    pictures: Mapping[str, tuple[AnyImage, AnyImage]],
    photo: AnyImage,
    *,
    label: str = "voxels",
    scale: int = 2,
) -> Panel:
    """A choice of maps; of each, the surface, what the Gaussians add (grey: nothing), the sum, and
    its error.

    Args:
        pictures: Name of the map -> its surface and its whole picture, of the size of ``photo``. At
            least one.
        photo: The photograph that all of them should look like.
        label: What the names are.
        scale: Screen pixels for each pixel.
    """
    names = list(pictures)

    def draw(choice: str) -> Drawn:
        surface, whole = (to_uint8(x) for x in pictures[choice])
        correction = ((whole.astype(int) - surface) + 128).clip(0, 255).astype("uint8")
        parts = [
            part.repeat(scale, 0).repeat(scale, 1)
            for part in (surface, correction, whole, error_map(whole, photo))
        ]
        words = (
            f"{label} {choice}: the surface alone, what the Gaussians add, the sum, and its error"
        )
        return side_by_side(
            parts, ["surface", "added by Gaussians", "sum", "|sum - photograph|"]
        ), words

    controls = {"choice": Choice(value=names[-1], options=names, label=label)}
    return Panel(draw, controls, name="surface", text="Surface, corrections and sum")
