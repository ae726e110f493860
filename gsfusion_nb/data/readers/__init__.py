"""Readers of recordings on disk, one file a layout, and what they share."""

from ..recorded.associate import associate as associate
from .folder import folder as folder
from .replica import replica as replica
from .scannetpp import scannetpp as scannetpp
from .seven_scenes import seven_scenes as seven_scenes
from .tum import tum as tum
