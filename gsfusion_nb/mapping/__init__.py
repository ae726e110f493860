"""The mappers, one frame step each, and the loop around them."""

from .gsfusion import GSFusion as GSFusion
from .map_sequence import FinishedRun as FinishedRun
from .map_sequence import resume_mapping as resume_mapping
from .map_sequence import run_mapping as run_mapping
from .report import GlobalStep as GlobalStep
from .report import StepReport as StepReport
from .rescore import rescore as rescore
from .run import MappingRun as MappingRun
