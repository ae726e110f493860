"""Depth of the first opaque disc at each pixel, and its gradient (RTG-SLAM)."""
