"""Panels for one pixel, one Gaussian or one tile: which Gaussians made a colour, and which gradients they get."""
