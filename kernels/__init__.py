"""Optional fast implementations, imported as ``gsfusion_nb.kernels`` by ``gsfusion_nb.backends`` and by nothing else."""
