"""Lists of the Gaussians that touch each tile, a stage of rasterize."""
