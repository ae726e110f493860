"""The mappers, one frame step each, and the loop around them."""

from .gsfusion import GSFusion as GSFusion
from .map_sequence import FinishedRun as FinishedRun
from .map_sequence import resume_mapping as resume_mapping
from .map_sequence import run_mapping as run_mapping
from .map_stream import map_stream as map_stream
from .report import GlobalStep as GlobalStep
from .report import StepReport as StepReport
from .rescore import rescore as rescore
from .rtg_slam import RTGSLAM as RTGSLAM
from .run import MappingRun as MappingRun
from .stream_run import StreamRun as StreamRun
from .systems import SYSTEMS as SYSTEMS
from .systems import Config as Config
from .systems import Mapper as Mapper
from .systems import get_system as get_system
from .systems import make_mapper as make_mapper
from .systems import system_of as system_of
