"""The check-up of a recording: errors in units, poses, intrinsics, registration or images, and what repairs them.

``check_recording(path)`` gives a ``CheckupReport``: print it, show it in a notebook, or write it as a page.
"""

from .check import check_recording as check_recording
from .findings import Finding as Finding
from .report import CheckupReport as CheckupReport
