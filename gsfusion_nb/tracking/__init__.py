"""Camera tracking: frame-to-model ICP, relocalisation, and the back end that closes loops."""

from .back_end import BackEnd as BackEnd
from .back_end import moved_enough as moved_enough
from .correction import Correction as Correction
from .features import Features as Features
from .features import extract_features as extract_features
from .icp import IcpIteration as IcpIteration
from .icp import IcpResult as IcpResult
from .icp import align as align
from .icp import icp as icp
from .keyframe_database import KeyframeDatabase as KeyframeDatabase
from .normal_equations import IcpSystem as IcpSystem
from .normal_equations import associate as associate
from .normal_equations import depth_weight as depth_weight
from .normal_equations import icp_system as icp_system
from .normal_equations import point_to_plane as point_to_plane
from .pyramid import DepthLevel as DepthLevel
from .pyramid import depth_pyramid as depth_pyramid
from .surface import Surface as Surface
from .surface import SurfaceSource as SurfaceSource
from .surface import tsdf_surface as tsdf_surface
from .tracker import Tracker as Tracker
from .tracker import TrackingLostError as TrackingLostError
from .tracking_report import TrackingReport as TrackingReport
