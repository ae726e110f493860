"""The check-up of a recording: errors in units, poses, intrinsics, registration or images, and the
options that repair them.

``check_recording(path)`` returns a ``CheckupReport``, which can be printed, shown in a notebook, or
written as a page.
"""

from .check import check_recording as check_recording
from .report import CheckupReport as CheckupReport
from .report import Finding as Finding
