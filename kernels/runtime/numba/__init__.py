"""Kernels for the CPU, compiled by numba on first use and cached on disk."""

from . import announce as announce
from . import compile_thread as compile_thread
from . import shared_cache as shared_cache
from .cache_place import choose_place

choose_place()
