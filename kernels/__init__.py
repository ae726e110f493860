"""Optional fast implementations, known as ``gsfusion_nb.kernels`` to ``gsfusion_nb.backends`` and
to nothing else."""
