"""Follow a pixel, a voxel or a Gaussian through everything that a mapper does to it: ``Trace(mapper)``."""

from .gaussian import AdamRow as AdamRow
from .gaussian import GaussianSeeded as GaussianSeeded
from .gaussian import GaussianStep as GaussianStep
from .gaussian import GaussianTrace as GaussianTrace
from .gaussian import Marks as Marks
from .gaussian import Moment as Moment
from .identity import Birth as Birth
from .identity import Event as Event
from .pixel_and_voxel import PixelFused as PixelFused
from .pixel_and_voxel import PixelSeeded as PixelSeeded
from .pixel_and_voxel import PixelStep as PixelStep
from .pixel_and_voxel import PixelTrace as PixelTrace
from .pixel_and_voxel import VoxelFused as VoxelFused
from .pixel_and_voxel import VoxelTrace as VoxelTrace
from .trace import Trace as Trace
from .trace import tracing as tracing
