"""Mean absolute and squared difference of a picture, with the gradient."""
