"""Recordings in other formats, written as the plain ``folder`` layout that can be checked and
mapped."""

from .conversion import ConvertReport as ConvertReport
from .formats import detect_format as detect_format
from .formats import known_formats as known_formats
from .recording import ConvertOptions as ConvertOptions
from .recording import RosOptions as RosOptions
from .run import convert as convert
from .trajectory import RecordedTrajectory as RecordedTrajectory
from .trajectory import read_trajectory as read_trajectory
