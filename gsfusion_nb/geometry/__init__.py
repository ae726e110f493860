"""Cameras, rigid transforms, quaternions, normals, spherical harmonics."""

from . import quaternion as quaternion
from . import se3 as se3
from .camera import backproject as backproject
from .camera import depth_to_points as depth_to_points
from .camera import pixel_grid as pixel_grid
from .camera import project as project
from .camera import rays as rays
from .normals import depth_to_normals as depth_to_normals
from .normals import normals_at as normals_at
from .sums import sum_rows as sum_rows
