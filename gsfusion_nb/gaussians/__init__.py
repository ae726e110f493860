"""The Gaussian map, its rows and their states."""

from .edit import SPLIT_SHRINKS as SPLIT_SHRINKS
from .edit import Edit as Edit
from .edit import shared as shared
from .model import PLY_BYTES as PLY_BYTES
from .model import GaussianModel as GaussianModel
from .moments import restart_optimiser as restart_optimiser
from .step_clock import StepClock as StepClock
from .surfels import OPAQUE as OPAQUE
from .surfels import STABLE as STABLE
from .surfels import TRANSPARENT as TRANSPARENT
from .surfels import UNSTABLE as UNSTABLE
from .surfels import SurfelModel as SurfelModel
from .surfels import Transitions as Transitions
from .surfels import change_states as change_states
from .surfels import count_errors as count_errors
from .surfels import count_views as count_views
from .surfels import fuse_with_history as fuse_with_history
from .surfels import radius_of as radius_of
from .surfels import state_counts as state_counts
