"""Pictures, live views and panels for notebooks. Import them from here; each is loaded when it is
first used.

The names, and where each is from, are in ``__init__.pyi``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
