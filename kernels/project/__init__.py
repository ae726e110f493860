"""Projection of Gaussians to the image and its gradient, a stage of rasterize."""
