"""The mapping systems, one frame step each."""

from .gps_slam import GPSSLAM as GPSSLAM
from .gsfusion import GSFusion as GSFusion
from .map_view import MapPart as MapPart
from .mapper import Mapper as Mapper
from .one_frame import DelayedInterrupt as DelayedInterrupt
from .one_frame import FrameUndone as FrameUndone
from .one_frame import HalfMappedError as HalfMappedError
from .rtg_slam import RTGSLAM as RTGSLAM
from .step_report import GlobalStep as GlobalStep
from .step_report import StepReport as StepReport
from .systems import SYSTEMS as SYSTEMS
from .systems import get_system as get_system
from .systems import make_mapper as make_mapper
from .systems import system_of as system_of
from .training import LossFunction as LossFunction
from .training import Training as Training
