"""Follow a pixel, a voxel or a Gaussian through everything that a mapper does to it: ``Trace(mapper)``."""

from .identity import Birth as Birth
from .identity import Event as Event
from .moment import Marks as Marks
from .moment import Moment as Moment
from .of_gaussian import AdamRow as AdamRow
from .of_gaussian import GaussianPast as GaussianPast
from .of_gaussian import GaussianSeeded as GaussianSeeded
from .of_gaussian import GaussianStates as GaussianStates
from .of_gaussian import GaussianStep as GaussianStep
from .of_gaussian import GaussianTrace as GaussianTrace
from .of_pixel import PixelFused as PixelFused
from .of_pixel import PixelSeeded as PixelSeeded
from .of_pixel import PixelStep as PixelStep
from .of_pixel import PixelTrace as PixelTrace
from .of_voxel import VoxelFused as VoxelFused
from .of_voxel import VoxelTrace as VoxelTrace
from .trace import Trace as Trace
from .trace import tracing as tracing
