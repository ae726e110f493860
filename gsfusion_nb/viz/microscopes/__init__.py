"""One pixel, one Gaussian, one tile at a time: what made a colour, and where gradients go."""
