"""Which Gaussians a camera sees, and how large they are in its image."""
