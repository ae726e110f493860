"""L1 loss of a picture with its gradient."""
