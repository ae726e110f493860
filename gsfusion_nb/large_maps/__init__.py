"""Parts of a large map: the rows that a view may show are found, drawn and stepped, and the others
wait.

Nothing here changes what a system does with a small map, whose only part is ``ALL_ROWS``
(``gsfusion_nb.types``).
"""

from .boxes import Boxes as Boxes
from .boxes import drawn_in_part as drawn_in_part
from .chunks import farthest_depth as farthest_depth
from .map_part import MapPart as MapPart
from .map_parts import MapParts as MapParts
from .map_parts import params_now as params_now
