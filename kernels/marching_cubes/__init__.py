"""Triangle mesh of the TSDF's zero level."""
