"""Posed RGB-D sequences: readers of public layouts, the built-in scene, selection and resizing.

Anything with ``__len__``, ``__getitem__``, ``pose``, ``camera`` and ``name`` is a sequence (``Sequence``). Frames are
decoded when asked for; nothing is kept in memory.
"""

from .open import detect_layout as detect_layout
from .open import layouts as layouts
from .open import open_sequence as open_sequence
from .protocol import BadFrameError as BadFrameError
from .protocol import Sequence as Sequence
from .protocol import SequenceError as SequenceError
from .protocol import SequenceNotFoundError as SequenceNotFoundError
from .readers.associate import associate as associate
from .readers.folder import folder as folder
from .readers.replica import replica as replica
from .readers.scannetpp import scannetpp as scannetpp
from .readers.seven_scenes import seven_scenes as seven_scenes
from .readers.tum import tum as tum
from .recorded import RecordedSequence as RecordedSequence
from .repair import repaired as repaired
from .resize import resize_frame as resize_frame
from .view import OpenedSequence as OpenedSequence
from .view import SequenceView as SequenceView
from .view import apply_options as apply_options
