"""Live views without a kernel: panels recorded over a grid, steppers step by step, maps and meshes with their data."""
