"""Losses, the optimiser of a growing map, keyframes."""

from .adam import adam_step as adam_step
from .adam import adam_update as adam_update
from .keyframes import Keyframe as Keyframe
from .keyframes import KeyframeList as KeyframeList
from .losses import dssim as dssim
from .losses import dssim_vjp as dssim_vjp
from .losses import l1 as l1
from .losses import l1_vjp as l1_vjp
