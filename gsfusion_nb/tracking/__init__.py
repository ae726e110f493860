"""Where the camera is: frame-to-model ICP, and the back end that closes loops."""
