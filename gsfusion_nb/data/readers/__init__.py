"""Readers of recordings on disk, one file per layout.

A new reader is one new file here: a function that reads a folder, and ``LAYOUT``, which says how to recognise one.
The name of the file is the name of the layout, which ``open_sequence``, the command line and the check of a recording
then know.
"""

from .folder import folder as folder
from .replica import replica as replica
from .scannetpp import scannetpp as scannetpp
from .seven_scenes import seven_scenes as seven_scenes
from .tum import tum as tum
