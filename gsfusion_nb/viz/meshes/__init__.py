"""Meshes in a notebook."""
