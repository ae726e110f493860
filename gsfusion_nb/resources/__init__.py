"""Cores and memory: what this process may use, how much it uses, and a map larger than that."""

from .map_memory import MAP_MEMORY as MAP_MEMORY
from .process import PeakMemory as PeakMemory
from .process import available_memory as available_memory
from .process import return_free_memory as return_free_memory
from .process import usable_cores as usable_cores
