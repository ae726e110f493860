"""Recordings in other formats, written as the plain ``folder`` layout that can be checked and mapped."""

from .detect import detect_format as detect_format
from .detect import known_formats as known_formats
from .options import ConvertOptions as ConvertOptions
from .options import RosOptions as RosOptions
from .run import ConvertReport as ConvertReport
from .run import convert as convert
from .trajectory import Trajectory as Trajectory
from .trajectory import read_trajectory as read_trajectory
