"""Frames that arrive over time: reading ahead, growing folders, depth cameras, dropping frames."""

from .background_frames import BackgroundFrames as BackgroundFrames
from .background_frames import read_ahead as read_ahead
from .depth_camera import CameraNotFoundError as CameraNotFoundError
from .depth_camera import DepthCamera as DepthCamera
from .frame_queue import POLICIES as POLICIES
from .frame_queue import FrameQueue as FrameQueue
from .frame_queue import Policy as Policy
from .growing_folder import GrowingFolder as GrowingFolder
from .kinect import AzureKinect as AzureKinect
from .live_source import LiveSource as LiveSource
from .realsense import RealSense as RealSense
from .selected_frames import SelectedFrames as SelectedFrames
