"""Unpacking archives that are not trusted."""

from .unpack import unpack as unpack
from .unpacker import Limits as Limits
