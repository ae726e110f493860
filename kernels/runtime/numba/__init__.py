"""Kernels for the CPU, compiled by numba on first use and cached on disk."""

from . import announce as announce
