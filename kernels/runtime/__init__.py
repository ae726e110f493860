"""What the kernels of each backend share: starting them, compiling them, vector arithmetic."""
