"""Picture of a Gaussian map and its gradient."""
