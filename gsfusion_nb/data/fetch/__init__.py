"""Fetching public data sets: download, verify, unpack, convert, and only then give the folder its name.

The scripts in ``data_scripts/`` say which files make a data set; everything they have in common is here.
"""

from .archive.unpack import unpack as unpack
from .archive.unpacker import Limits as Limits
from .errors import ArchiveError as ArchiveError
from .errors import ChecksumError as ChecksumError
from .errors import DeclinedError as DeclinedError
from .errors import DownloadError as DownloadError
from .errors import FetchError as FetchError
from .errors import NoSpaceError as NoSpaceError
from .obtain import Terms as Terms
from .obtain import obtain as obtain
from .plan import Item as Item
from .plan import Plan as Plan
from .sequence_on_disk import SequenceOnDisk as SequenceOnDisk
