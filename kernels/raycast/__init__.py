"""Surface of the TSDF seen from a camera."""
