"""Image quadtree of GSFusion."""
