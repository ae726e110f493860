"""Observers: a function that sees the calls of marked functions, such as the course's tracing.

Nothing is watched by default; a marked function then costs one look at a variable.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

Observer = Callable[[str, Callable[..., Any], tuple[Any, ...], dict[str, Any]], Any]
"""``observer(name, f, args, kwargs)`` must return ``f(*args, **kwargs)``; it may look at arguments
and result before and after, and must not change them."""

_observers: ContextVar[tuple[Observer, ...]] = ContextVar("gsfusion_observers", default=())


def observed(f: F) -> F:
    """Mark a function or method, so that an observer sees its calls under its qualified name, such
    as "Adam.step"."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        run = f
        for observer in _observers.get():
            run = functools.partial(_seen, observer, f.__qualname__, run)
        return run(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


def _seen(observer: Observer, name: str, f: Callable, *args: Any, **kwargs: Any) -> Any:
    return observer(name, f, args, kwargs)


@contextlib.contextmanager
def observing(observer: Observer | None, *, alone: bool = True) -> Iterator[None]:
    """Context in which ``observer`` sees the calls of marked functions in this thread; ``None``:
    nobody does.

    Args:
        observer: The observer.
        alone: Whoever sees the calls already does not see them in this context. Else both do.
    """
    outer = () if alone else _observers.get()
    token = _observers.set(outer if observer is None else (*outer, observer))
    try:
        yield
    finally:
        _observers.reset(token)
