"""Losses, the optimiser of a growing map, keyframes."""

from .adam import ColumnRates as ColumnRates
from .adam import adam_step as adam_step
from .adam import adam_update as adam_update
from .adam import adam_update_map as adam_update_map
from .align_view import PoseSystem as PoseSystem
from .align_view import flow_of_motion as flow_of_motion
from .align_view import pose_step as pose_step
from .align_view import pose_system as pose_system
from .fit_pose import PoseFit as PoseFit
from .fit_pose import fit_pose as fit_pose
from .fusion import fuse_with_history as fuse_with_history
from .keyframes import Keyframe as Keyframe
from .keyframes import KeyframeList as KeyframeList
from .losses import L1Loss as L1Loss
from .losses import depth_l1 as depth_l1
from .losses import depth_l1_vjp as depth_l1_vjp
from .losses import dssim as dssim
from .losses import dssim_vjp as dssim_vjp
from .losses import l1 as l1
from .losses import l1_mse_vjp as l1_mse_vjp
from .losses import l1_vjp as l1_vjp
from .map_penalties import add_penalties_ as add_penalties_
from .rgbd_loss import RgbdLoss as RgbdLoss
from .rgbd_loss import rgbd_l1_vjp as rgbd_l1_vjp
from .row_adam import RowAdam as RowAdam
