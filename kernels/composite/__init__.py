"""Front-to-back blending of each tile's Gaussians and its gradient, a stage of rasterize."""
