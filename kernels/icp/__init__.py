"""Normal equations of point-to-plane ICP."""
