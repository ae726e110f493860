"""Sums of the brightness error that joins ICP."""
