"""Settings of a run: frozen dataclasses with the unit in the name, and presets named after papers
and data sets."""

from .gps_slam import BaseConfig as BaseConfig
from .gps_slam import GpsSlamConfig as GpsSlamConfig
from .gps_slam import ScheduleConfig as ScheduleConfig
from .gps_slam import gps_slam as gps_slam
from .gps_slam import gps_slam_fidelities as gps_slam_fidelities
from .gps_slam import gps_slam_fidelity as gps_slam_fidelity
from .gsfusion import GSFusionConfig as GSFusionConfig
from .gsfusion import OptimConfig as OptimConfig
from .gsfusion import gsfusion as gsfusion
from .gsfusion import gsfusion_fidelities as gsfusion_fidelities
from .gsfusion import gsfusion_fidelity as gsfusion_fidelity
from .gsfusion import presets as presets
from .parts import DataConfig as DataConfig
from .parts import SeedingConfig as SeedingConfig
from .parts import SystemConfig as SystemConfig
from .parts import TrackingConfig as TrackingConfig
from .parts import TsdfConfig as TsdfConfig
from .preset_table import Presets as Presets
from .repair import RepairConfig as RepairConfig
from .rtg_slam import DiscConfig as DiscConfig
from .rtg_slam import RtgSlamConfig as RtgSlamConfig
from .rtg_slam import StateConfig as StateConfig
from .rtg_slam import WindowConfig as WindowConfig
from .rtg_slam import rtg_slam as rtg_slam
from .rtg_slam import rtg_slam_fidelities as rtg_slam_fidelities
from .rtg_slam import rtg_slam_fidelity as rtg_slam_fidelity
from .values import from_dict as from_dict
from .values import from_run as from_run
from .values import replace as replace
from .values import to_dict as to_dict
