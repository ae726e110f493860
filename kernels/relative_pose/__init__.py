"""Least squares of matched points for the relative pose of two views."""
