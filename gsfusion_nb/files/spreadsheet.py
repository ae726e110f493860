"""Text of others in a table that a spreadsheet opens."""

_FORMULAS = ("=", "+", "-", "@", "\t", "\r")
"""First characters that make a spreadsheet compute a cell."""


def plain_cell(text: str) -> str:
    """Text on one line that a spreadsheet shows and does not compute."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return f"'{line}" if line.lstrip().startswith(_FORMULAS) or text.startswith(_FORMULAS) else line
