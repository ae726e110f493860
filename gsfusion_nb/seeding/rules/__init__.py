"""One file per rule; importing a file registers its rule."""

from .dense import dense as dense
from .gsfusion import gsfusion as gsfusion
from .uniform import uniform as uniform
