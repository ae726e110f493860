"""The mapping systems, one frame step each."""

from .description import SystemDescription as SystemDescription
from .disc_files import disc_mesh as disc_mesh
from .frame_guard import FrameUndone as FrameUndone
from .frame_guard import HalfMappedError as HalfMappedError
from .gps_slam import GPSSLAM as GPSSLAM
from .gsfusion import GSFusion as GSFusion
from .gsfusion import draw as draw
from .mapper import Mapper as Mapper
from .rtg_slam import RTGSLAM as RTGSLAM
from .step_report import GlobalStep as GlobalStep
from .step_report import StepReport as StepReport
from .step_report import as_floats as as_floats
from .systems import SYSTEMS as SYSTEMS
from .systems import get_system as get_system
from .systems import make_mapper as make_mapper
from .systems import mapping_system as mapping_system
from .systems import package_of as package_of
from .systems import system_names as system_names
from .systems import system_of as system_of
from .training import LossFunction as LossFunction
from .tsdf_mapping import TsdfMapping as TsdfMapping
from .view_steps import step_on_view as step_on_view
