"""The splat viewer: a Gaussian map in a notebook cell, and pictures of Gaussian maps."""
