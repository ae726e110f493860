"""A process that loads kernels of a folder, and counts what numba compiles for them."""

LOAD_TRIAL = """
spec = importlib.util.spec_from_file_location("gsfusion_nb.kernels.trial", folder / "trial.py")
trial = sys.modules["gsfusion_nb.kernels.trial"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(trial)
class Count(event.Listener):
    names = []
    def on_start(self, event):
        self.names.append(event.data["dispatcher"].py_func.__name__)
    def on_end(self, event):
        pass
event.register("numba:compile", Count())
"""
"""Lines that load ``folder / "trial.py"`` as a module of the kernels; ``Count.names`` then has the
functions that were compiled. Before them stand the imports of ``importlib.util``, ``sys`` and
numba's ``event``."""
