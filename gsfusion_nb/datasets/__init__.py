"""Posed RGB-D sequences: readers of public layouts, the built-in scene, selection and resizing.

Anything with ``__len__``, ``__getitem__``, ``pose``, ``camera`` and ``name`` is a sequence (``Sequence``). Frames are
decoded when asked for; nothing is kept in memory.
"""

from .associate import associate as associate
from .consistency import DepthAgreement as DepthAgreement
from .consistency import SequenceCheck as SequenceCheck
from .consistency import check_sequence as check_sequence
from .consistency import depth_agreement as depth_agreement
from .folder import folder as folder
from .open import detect_layout as detect_layout
from .open import layouts as layouts
from .open import open_sequence as open_sequence
from .protocol import BadFrameError as BadFrameError
from .protocol import Sequence as Sequence
from .protocol import SequenceError as SequenceError
from .protocol import SequenceNotFoundError as SequenceNotFoundError
from .recorded import RecordedSequence as RecordedSequence
from .repair import repaired as repaired
from .replica import replica as replica
from .resize import resize_frame as resize_frame
from .scannetpp import scannetpp as scannetpp
from .seven_scenes import seven_scenes as seven_scenes
from .tum import tum as tum
from .view import OpenedSequence as OpenedSequence
from .view import SequenceView as SequenceView
from .view import apply_options as apply_options
