"""Posed RGB-D sequences: readers of public layouts, the built-in scene, selection and resizing.

Anything with ``__len__``, ``__getitem__``, ``pose``, ``camera`` and ``name`` is a sequence
(``Sequence``). Frames are decoded when asked for; nothing is kept in memory.
"""

from ..errors import BadFrameError as BadFrameError
from ..errors import SequenceError as SequenceError
from ..errors import SequenceNotFoundError as SequenceNotFoundError
from .adjust.repair import repaired as repaired
from .adjust.resize import resize_frame as resize_frame
from .adjust.selection import FrameSubset as FrameSubset
from .adjust.selection import OpenedSequence as OpenedSequence
from .adjust.selection import apply_options as apply_options
from .frame_store import FrameStore as FrameStore
from .open import data_files as data_files
from .open import detect_layout as detect_layout
from .open import frame_fingerprints as frame_fingerprints
from .open import open_sequence as open_sequence
from .open import sequence_fingerprint as sequence_fingerprint
from .readers.folder import folder as folder
from .readers.replica import replica as replica
from .readers.scannetpp import scannetpp as scannetpp
from .readers.seven_scenes import seven_scenes as seven_scenes
from .readers.tum import tum as tum
from .recorded.recorded_sequence import RecordedSequence as RecordedSequence
from .recorded.times import associate as associate
from .sequence import Sequence as Sequence
