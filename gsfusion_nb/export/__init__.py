"""Files for other programs (Gaussian PLY, mesh PLY and GLB, trajectory) and checkpoints, all written atomically."""

from .checkpoint_store import CheckpointStore as CheckpointStore
from .checkpoint_store import Saved as Saved
from .gaussian_ply import read_gaussian_ply as read_gaussian_ply
from .gaussian_ply import write_gaussian_ply as write_gaussian_ply
from .mesh_glb import write_mesh_glb as write_mesh_glb
from .mesh_ply import read_mesh_ply as read_mesh_ply
from .mesh_ply import write_mesh_ply as write_mesh_ply
from .trajectory import read_trajectory_tum as read_trajectory_tum
from .trajectory import write_trajectory_tum as write_trajectory_tum
