"""Spherical harmonics, a stage of rasterize."""
