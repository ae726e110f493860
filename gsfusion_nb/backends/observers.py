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

_observer: ContextVar[Observer | None] = ContextVar("gsfusion_observer", default=None)


def observed(f: F) -> F:
    """Mark a function or method, so that an observer sees its calls under its qualified name, such
    as "Adam.step"."""

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        observer = _observer.get()
        return f(*args, **kwargs) if observer is None else observer(f.__qualname__, f, args, kwargs)

    return call  # pyright: ignore[reportReturnType]


@contextlib.contextmanager
def observing(observer: Observer | None) -> Iterator[None]:
    """Context in which ``observer`` sees the calls of marked functions in this thread; ``None``:
    nobody does."""
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


@contextlib.contextmanager
def also_observing(observer: Observer) -> Iterator[None]:
    """Context in which ``observer`` sees the calls, besides whoever sees them already."""
    outer = _observer.get()

    def both(name: str, f: Callable, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        def seen_by_outer(*args: Any, **kwargs: Any) -> Any:
            return f(*args, **kwargs) if outer is None else outer(name, f, args, kwargs)

        return observer(name, seen_by_outer, args, kwargs)

    with observing(both):
        yield
