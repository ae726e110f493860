"""Voxels that contain given points, as they are and as a frame will change them."""
