"""Voxels nearest to given points."""
