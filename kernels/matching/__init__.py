"""Matching of descriptors: those of two views, and those of points near their predicted pixels."""
