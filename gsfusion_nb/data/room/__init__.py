"""The built-in scene: a furnished room with procedural textures and lighting, and exact depth,
poses, distance field and mesh.

World frame: z up, origin on the floor in the middle of the room, metres; 5 m along x, 4 m along y,
2.6 m high.
"""

from .depth_noise import kinect_depth as kinect_depth
from .depth_noise import stereo_depth as stereo_depth
from .sequence import RoomSequence as RoomSequence
from .sequence import render_room as render_room
from .sequence import room as room
from .surface import room_mesh as room_mesh
from .surface import room_sdf as room_sdf
