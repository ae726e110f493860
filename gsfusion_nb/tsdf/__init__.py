"""The volumetric map: sparse blocks of truncated signed distance, fused from depth images."""

from .allocate import allocate as allocate
from .allocate import band_blocks as band_blocks
from .allocate import new_band_blocks as new_band_blocks
from .block_pool import estimate_memory as estimate_memory
from .fused_view import FusedView as FusedView
from .fused_view import sample_fused_voxels as sample_fused_voxels
from .integrate import IntegrateReport as IntegrateReport
from .integrate import fuse_frame_ as fuse_frame_
from .integrate import integrate as integrate
from .marching_cubes import extract_mesh as extract_mesh
from .octree import BlockIndex as BlockIndex
from .octree import NewBlocks as NewBlocks
from .raycast import RaycastOutput as RaycastOutput
from .raycast import raycast as raycast
from .volume import TsdfSample as TsdfSample
from .volume import TsdfVolume as TsdfVolume
from .volume import sample_voxels as sample_voxels
from .voxel_update import tsdf_update as tsdf_update
