"""Say once that kernels are being compiled: the first call on a machine takes some seconds without it looking so."""

import logging

from numba.core import event

log = logging.getLogger(__name__)

_KERNELS = __name__.split(".runtime.")[0]


class CompileNotice(event.Listener):
    """Logs a warning, which a notebook shows, when numba compiles one of our functions; cached ones are silent."""

    def __init__(self):
        self.given = False

    def on_start(self, event: event.Event) -> None:
        """Called by numba before it compiles a function that it did not find in the cache on disk."""
        function = event.data["dispatcher"].py_func  # pyright: ignore[reportOptionalSubscript]
        if self.given or not function.__module__.startswith(_KERNELS):
            return
        self.given = True
        log.warning(
            "compiling the numba kernels that this command needs (once on this machine, 10 to 120 s) ... "
            "`gsfusion-nb doctor --warm` does it once for all"
        )

    def on_end(self, event: event.Event) -> None:
        """Nothing to say."""


event.register("numba:compile", CompileNotice())
