"""Which voxel blocks a frame's depth touches."""
