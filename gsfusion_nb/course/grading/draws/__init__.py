"""Hidden inputs of the exercises, drawn from a seed: on each, a submission must agree with the reference.

They are the same for all students of a class, and in no file that a student has.
"""

from . import scans as scans
from . import splats as splats
from . import systems as systems
from .registry import DRAWS as DRAWS
from .registry import whole as whole
