"""Kernels for NVIDIA GPUs in CUDA C++, compiled on first use by NVRTC and cached on disk: no
toolkit is needed.

``GSFUSION_CUDA_EMULATOR``, set before Python starts, names a library with the same kernels compiled
for the CPU, which then takes CPU tensors: very slow, for tests.
"""
