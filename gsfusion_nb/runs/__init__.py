"""Runs of a mapper over a sequence or a stream: the loop, the clock, checkpoints, files and scores."""

from .map_sequence import FinishedRun as FinishedRun
from .map_sequence import resume_mapping as resume_mapping
from .map_sequence import run_mapping as run_mapping
from .map_stream import map_stream as map_stream
from .rescore import rescore as rescore
from .run import MappingRun as MappingRun
from .stream_run import StreamRun as StreamRun
