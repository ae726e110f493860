"""A doctor for recordings: what is wrong with units, poses, intrinsics, registration or images, and what repairs it.

``check_recording(path)`` gives a ``CheckupReport``: print it, show it in a notebook, or write it as a page.
"""

from .check import check_recording as check_recording
from .findings import Finding as Finding
from .report import CheckupReport as CheckupReport
