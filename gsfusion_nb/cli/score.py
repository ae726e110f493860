"""``gsfusion-nb eval``: the scores of a finished run, computed again."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from ..backends import backend_names, from_environment, use_backend
from ..config.options import named
from .result import print_metrics
from .settings import system_names


@dataclass(frozen=True, kw_only=True)
class EvalOptions:
    """Score the maps of a finished run again, with the views and poses of the run.

    The numbers should be the same; where they differ, the command reports both."""

    run: Annotated[str, tyro.conf.Positional]
    """Folder of the run."""
    data: str = ""
    """Folder of the sequence, if it was moved."""
    system: str = named("", system_names)
    """System of the run; needed only if it came from a file, FILE.py:Name, which is executed."""
    lpips: bool = False
    """Also compute LPIPS (needs the extra "lpips" and AlexNet's weights)."""
    device: str = ""
    """Where to render: cpu or cuda. Default: as in the run."""
    backend: str = named(from_environment, backend_names)
    """What the operations run on; the environment variable GSFUSION_BACKEND changes the default."""


def run(options: EvalOptions) -> int:
    """The command. Exit status 0: the scores are printed."""
    from ..runs import rescore

    with use_backend(options.backend):
        metrics = rescore(
            options.run,
            data=options.data or None,
            system=options.system or None,
            with_lpips=options.lpips,
            device=options.device or None,
        )
    print_metrics(metrics)
    return 0
