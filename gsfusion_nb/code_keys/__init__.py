"""Keys of code: what a function of the user's, or a program, is made of, as a hash that changes
with it.

Where code comes from (``origin``, ``installed``), what it is made of (``key``, from ``digest``,
``names``, ``objects``, ``programs`` and ``values``), and what was replaced in libraries
(``patches``).
"""

from .key import CodeKey as CodeKey
from .key import code_key as code_key
from .key import rule_fingerprint as rule_fingerprint
