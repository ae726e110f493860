"""The rows of a mapper's map that a view may show, with the Adam whose steps the others miss."""

from collections.abc import Callable
from functools import partial
from typing import Any

from torch import Tensor

from ..config import SystemConfig
from ..large_maps import MapParts
from ..optim import Keyframe, take_missed_steps
from ..types import Frame


def parts_of_map(mapper: Any) -> MapParts:
    """The parts of the map of a ``Mapper`` whose Adam is that of ``row_optim``."""
    catch_up = None
    if mapper.row_optim is not None and mapper.training.optimiser is None:
        catch_up = partial(take_missed_steps, config=mapper.row_optim)
    return MapParts(mapper.gaussians, catch_up, depth_behind_views(mapper.config))


def depth_behind_views(config: SystemConfig) -> Callable[[Frame | Keyframe], Tensor | None]:
    """A function from a view to its measured depth, behind which its steps reach no rows; to None
    where they reach all of them."""

    def depth_of(view: Frame | Keyframe) -> Tensor | None:
        if config.all_in_view:
            return None
        return view.farthest_m if isinstance(view, Keyframe) else view.depth_m

    return depth_of
