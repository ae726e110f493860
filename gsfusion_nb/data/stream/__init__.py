"""Frames that arrive over time: reading ahead, growing folders, depth cameras, dropping frames."""

from .cameras import CameraNotFoundError as CameraNotFoundError
from .cameras import RealSense as RealSense
from .frame_queue import POLICIES as POLICIES
from .frame_queue import BackgroundFrames as BackgroundFrames
from .frame_queue import LiveSource as LiveSource
from .frame_queue import Policy as Policy
from .frame_queue import SelectedFrames as SelectedFrames
from .frame_queue import read_ahead as read_ahead
from .growing_folder import GrowingFolder as GrowingFolder
