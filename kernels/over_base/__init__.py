"""Gaussians over a picture of the surface, blended without order, and the gradient."""
