"""``gsfusion-nb study``: the papers' comparisons and ablations, one command each."""

from .disc_depth import FitRow as FitRow
from .disc_depth import fit_image as fit_image
from .disc_depth import fit_images as fit_images
from .run import StudyOptions as StudyOptions
from .run import main as main
from .variants import STUDIES as STUDIES
from .variants import Study as Study
