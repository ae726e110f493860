"""Files: written completely or not at all, hashed, and read within limits.

All other modules read files of other people and programs through this room.
"""

from ..errors import BadFrameError as BadFrameError
from ..errors import SequenceError as SequenceError
from .archives import LEAST_MEMORY_BYTES as LEAST_MEMORY_BYTES
from .archives import MOST_MEMORY_PER_BYTE as MOST_MEMORY_PER_BYTE
from .archives import check_memory as check_memory
from .archives import inflate as inflate
from .archives import open_archive as open_archive
from .archives import open_arrays as open_arrays
from .archives import read_member as read_member
from .atomic import atomic_file as atomic_file
from .atomic import atomic_folder as atomic_folder
from .atomic import move_into_place as move_into_place
from .atomic import remove_partial as remove_partial
from .atomic import write_file as write_file
from .foreign import IMAGE_BYTES as IMAGE_BYTES
from .foreign import TEXT_BYTES as TEXT_BYTES
from .foreign import is_file as is_file
from .foreign import noting_files as noting_files
from .foreign import open_regular as open_regular
from .foreign import parsing as parsing
from .foreign import read_bytes as read_bytes
from .foreign import read_exactly as read_exactly
from .foreign import read_text as read_text
from .hashes import UNREADABLE as UNREADABLE
from .hashes import cache_folder as cache_folder
from .hashes import file_hashes as file_hashes
from .json_objects import parse_json as parse_json
from .json_objects import read_object as read_object
from .json_objects import read_sealed as read_sealed
from .json_objects import write_sealed as write_sealed
from .lock import try_lock as try_lock
from .spreadsheet import plain_cell as plain_cell
