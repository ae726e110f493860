"""Compile kernels in a thread of their own, so that Ctrl-C is heard meanwhile, and without looking
for garbage.

Python hears a signal between two of its own instructions, and the compiler of one kernel may take
half a minute without any. The main thread waits for it here in small steps. After Ctrl-C the
compiler goes on until its kernel is on disk: the next call has it then, or waits for it.
"""

import atexit
import contextlib
import functools
import gc
import threading
from collections.abc import Callable, Iterator
from typing import Any

from numba.core import dispatcher
from numba.core.compiler_lock import global_compiler_lock

from gsfusion_nb.compile_clock import COMPILE_CLOCK
from gsfusion_nb.interrupts import compiler_goes_on, not_waited_for

_KERNELS = __name__.split(".runtime.")[0]
_POLL_S = 0.05
_STACK_BYTES = 16 << 20
"""Of the thread: twice what a main thread has on Linux. Other threads have 1 MB on Windows, and the
compiler's recursion is deep."""


class Compilation(threading.Thread):
    """One call of the compiler."""

    def __init__(self, call: Callable[[], Any], name: str):
        super().__init__(name=f"compiling {name}", daemon=True)
        self._call = call
        self._value: Any = None
        self._error: BaseException | None = None
        self._compiled_s = 0.0
        self._compiled_cpu_s = 0.0

    def run(self) -> None:
        """Called by the thread."""
        try:
            self._value = self._call()
        except BaseException as error:
            self._error = error
        finally:
            # nothing, where the kernel was on disk
            self._compiled_s = COMPILE_CLOCK.seconds
            self._compiled_cpu_s = COMPILE_CLOCK.cpu_seconds
            not_waited_for.remove(self)

    def result(self) -> Any:
        """Wait for the end; what the call returned or raised. ``KeyboardInterrupt`` leaves the
        compiler alone."""
        while self.is_alive():
            self.join(_POLL_S)
            compiler_goes_on()
        COMPILE_CLOCK.add(self._compiled_s, self._compiled_cpu_s)
        if self._error is not None:
            raise self._error
        return self._value

    @classmethod
    def begin(cls, call: Callable[[], Any], name: str) -> "Compilation":
        """Start the thread.

        Raises:
            RuntimeError: no thread can be started, because memory is limited.
        """
        compilation = cls(call, name)
        usual_bytes = threading.stack_size(_STACK_BYTES)
        not_waited_for.append(compilation)
        try:
            compilation.start()
        except RuntimeError:
            not_waited_for.remove(compilation)
            raise
        finally:
            threading.stack_size(usual_bytes)
        return compilation


@atexit.register
def wait_for_compilers() -> None:
    """At the end of a process that nobody ended at once (``end_process``): the library of the
    compiler must not be taken away while it works."""
    for compilation in list(not_waited_for):
        compilation.join()


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """A block in which Python does not look for cycles of objects that nobody uses.

    The compiler makes millions of objects, so it looks often, each time at all that torch and numba
    hold as well: a tenth of the time of compiling. What is left is found after the block.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


_compile = dispatcher.Dispatcher.compile


@functools.wraps(_compile)
def compile_and_listen(self: dispatcher.Dispatcher, sig: Any) -> Any:
    """``Dispatcher.compile``, in a thread where the main thread compiles one of our functions. One
    that a function in the compiler calls is compiled with it, under the lock of its thread."""
    is_ours = self.py_func.__module__.startswith(_KERNELS)
    is_main = threading.current_thread() is threading.main_thread()
    compilation = None
    if not is_ours or global_compiler_lock.is_locked():
        return _compile(self, sig)
    with no_collection():
        if is_main:
            with contextlib.suppress(RuntimeError):
                compilation = Compilation.begin(lambda: _compile(self, sig), self.py_func.__name__)
        return compilation.result() if compilation else _compile(self, sig)


dispatcher.Dispatcher.compile = compile_and_listen  # pyright: ignore[reportAttributeAccessIssue]
