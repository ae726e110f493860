"""Fetching public data sets: download, verify, unpack and convert; the folder gets its name when all is done.

The scripts in ``data_scripts/`` list the files of each data set; the code that they share is here.
"""

from .archive.unpack import unpack as unpack
from .archive.unpacker import Limits as Limits
from .errors import ArchiveError as ArchiveError
from .errors import ChecksumError as ChecksumError
from .errors import DeclinedError as DeclinedError
from .errors import DownloadError as DownloadError
from .errors import FetchError as FetchError
from .errors import NoSpaceError as NoSpaceError
from .fetch_data_set import FetchOptions as FetchOptions
from .fetch_data_set import fetch_data_set as fetch_data_set
from .plan import Item as Item
from .plan import Plan as Plan
from .sequence_on_disk import SequenceOnDisk as SequenceOnDisk
