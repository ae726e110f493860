"""Files for other programs (Gaussians, meshes, both in glTF or OpenUSD, trajectories) and
checkpoints, all atomic."""

from .checkpoint_store import CheckpointStore as CheckpointStore
from .gaussian_ply import read_gaussian_ply as read_gaussian_ply
from .gaussian_ply import write_gaussian_ply as write_gaussian_ply
from .glb import write_map_glb as write_map_glb
from .ply import read_mesh_ply as read_mesh_ply
from .ply import write_mesh_ply as write_mesh_ply
from .trajectory import read_trajectory_tum as read_trajectory_tum
from .trajectory import write_trajectory_tum as write_trajectory_tum
from .tsdf_file import read_tsdf as read_tsdf
from .tsdf_file import write_tsdf as write_tsdf
from .usd import write_map_usda as write_map_usda
