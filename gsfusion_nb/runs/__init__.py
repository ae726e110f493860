"""Runs of a mapper over a sequence or a stream: the loop over the frames, timing, checkpoints,
files and scores."""

from .driver import FinishedRun as FinishedRun
from .located import locate as locate
from .located_frames import LocatedRecording as LocatedRecording
from .map_sequence import map_stream as map_stream
from .map_sequence import resume_mapping as resume_mapping
from .map_sequence import run_mapping as run_mapping
from .mapping_run import MappingRun as MappingRun
from .report import ReportData as ReportData
from .report import write_report as write_report
from .report_panel import ReportPanel as ReportPanel
from .rescore import rescore as rescore
from .run_folder import CheckpointEvery as CheckpointEvery
from .stream_onto import stream_onto as stream_onto
from .stream_run import StreamRun as StreamRun
