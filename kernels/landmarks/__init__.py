"""Least squares of landmarks for the pose of a camera."""
