"""Cameras with lens distortion: removing it, and registering depth to the colour of another camera."""
