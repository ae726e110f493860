"""Where new Gaussians are created: the image quadtree, the context that a rule sees, the registry, and the rules."""

from ..types import Seeds as Seeds
from . import rules as rules
from .check import RuleCheck as RuleCheck
from .check import check_rule as check_rule
from .check_scenes import check_contexts as check_contexts
from .context import MapView as MapView
from .context import SeedContext as SeedContext
from .context import VoxelLookup as VoxelLookup
from .fingerprint import is_built_in as is_built_in
from .fingerprint import rule_fingerprint as rule_fingerprint
from .fingerprint import rule_source as rule_source
from .quadtree import Cells as Cells
from .quadtree import quadtree as quadtree
from .rule import SeedingRule as SeedingRule
from .rule import apply_rule as apply_rule
from .rule import check_options as check_options
from .rule import get_rule as get_rule
from .rule import keep_one_per_voxel as keep_one_per_voxel
from .rule import registered as registered
from .rule import rule_choices as rule_choices
from .rule import rule_name as rule_name
from .rule import rule_options as rule_options
from .rule import seeding_rule as seeding_rule
from .unchanged_inputs import ChangedInputError as ChangedInputError
