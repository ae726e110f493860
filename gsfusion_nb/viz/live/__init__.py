"""Online mapping and other loops to watch while they run, and a camera that is moved by sliders."""
