"""The pose of a frame in a map that it does not change."""

from jaxtyping import Float
from torch import Tensor

from ..config import TrackingConfig
from ..types import Frame
from .attempt import Sight, Start, attempt, why_no_fit, why_not_alike
from .surface import SurfaceSource


def localise(
    frame: Frame,
    surface: SurfaceSource,
    guess: Float[Tensor, "4 4"],
    config: TrackingConfig | None = None,
) -> Float[Tensor, "4 4"] | None:
    """Align a frame with the map alone, by ICP from a pose near its own, then once more with wide
    limits.

    Args:
        frame: Its own ``T_WC`` is not used.
        surface: Renders the map; it is called at a few poses.
        guess: Camera-to-world pose to start from, such as one between those of the frames before
            and after it.
        config: Pyramid levels and limits.

    Returns:
        The camera-to-world pose, float64, or ``None``: no start led to a pose that fits.
    """
    config = config or TrackingConfig()
    sight = Sight.of(frame, config)
    if not sight.has_depth:
        return None
    start = guess.double().cpu()
    for from_there in (Start("there", start), Start("there, wide limits", start, wide=True)):
        result = attempt(sight, surface, surface, from_there, config).result
        if why_no_fit(result, strict=from_there.wide):
            continue
        if not why_not_alike(
            frame,
            surface(frame.camera, result.T_WC.float()),
            doubtful=False,
        ):
            return result.T_WC
    return None
