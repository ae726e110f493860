"""Follow a Gaussian or a voxel through everything that a mapper does to it: ``Trace(mapper)``."""

from .trace import Trace as Trace
from .trace import tracing as tracing
