"""Say once that kernels are being compiled: the first call on a machine takes some seconds without
it looking so. And count its time.
"""

import logging

from numba.core import event

from gsfusion_nb.compile_clock import COMPILE_CLOCK

log = logging.getLogger(__name__)

_KERNELS = __name__.split(".runtime.")[0]


class CompileNotice(event.Listener):
    """Logs a warning, which a notebook shows, when numba compiles one of our functions; cached ones
    are silent."""

    def __init__(self):
        self.given = False

    def on_start(self, event: event.Event) -> None:
        """Called by numba before it compiles a function that it did not find in the cache on
        disk."""
        function = event.data["dispatcher"].py_func  # pyright: ignore[reportOptionalSubscript]
        if self.given or not function.__module__.startswith(_KERNELS):
            return
        self.given = True
        log.warning(
            "compiling the numba kernels that this command needs (once on this machine, 10 to 120 "
            "s) ... `gsfusion-nb doctor --warm` does it once for all"
        )

    def on_end(self, event: event.Event) -> None:
        """Nothing to say."""


class CompileTimer(event.Listener):
    """Counts the time of compiling, so that it is not taken for mapping."""

    def on_start(self, event: event.Event) -> None:
        """Called by numba before it compiles a function."""
        COMPILE_CLOCK.begin()

    def on_end(self, event: event.Event) -> None:
        """Called by numba after it, and after it failed."""
        COMPILE_CLOCK.end()


event.register("numba:compile", CompileNotice())
event.register("numba:compile", CompileTimer())
