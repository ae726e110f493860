"""The Gaussian map, its rows and their states."""

from .apply_edit import SPLIT_SHRINKS as SPLIT_SHRINKS
from .apply_edit import shared as shared
from .edit import Edit as Edit
from .model import GaussianModel as GaussianModel
from .states import Transitions as Transitions
from .states import change_states as change_states
from .states import count_errors as count_errors
from .states import count_views as count_views
from .surfels import OPAQUE as OPAQUE
from .surfels import STABLE as STABLE
from .surfels import TRANSPARENT as TRANSPARENT
from .surfels import UNSTABLE as UNSTABLE
from .surfels import SurfelModel as SurfelModel
from .surfels import state_counts as state_counts
