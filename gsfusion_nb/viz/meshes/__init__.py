"""Meshes in a notebook: turned with the mouse, or as a picture."""
