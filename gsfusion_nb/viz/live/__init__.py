"""Live views of online mapping and of other loops while they run, and a camera that is moved with sliders."""
