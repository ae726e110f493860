"""Frames as they come: reading ahead, folders that grow, depth cameras, and what happens when mapping is too slow."""

from .background import BackgroundFrames as BackgroundFrames
from .background import read_ahead as read_ahead
from .depth_camera import CameraNotFoundError as CameraNotFoundError
from .depth_camera import DepthCamera as DepthCamera
from .growing import GrowingFolder as GrowingFolder
from .kinect import AzureKinect as AzureKinect
from .live_source import LiveSource as LiveSource
from .mailbox import POLICIES as POLICIES
from .mailbox import Mailbox as Mailbox
from .mailbox import Policy as Policy
from .realsense import RealSense as RealSense
from .selected import SelectedFrames as SelectedFrames
