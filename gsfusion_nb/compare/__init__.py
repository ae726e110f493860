"""Rules, settings, systems and scenes compared by runs with equal budgets. Each name is loaded when
first used."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
