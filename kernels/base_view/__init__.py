"""The base of a picture: holes of a surface filled, half a picture enlarged."""
