"""One file per rule; importing a file registers its rule."""

from .dense import dense as dense
from .gsfusion import gsfusion as gsfusion
from .rtg_slam import rtg_slam as rtg_slam
from .uniform import uniform as uniform
