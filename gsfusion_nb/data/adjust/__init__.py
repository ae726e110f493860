"""Changes to a sequence after reading: selection, size, depth limits, corrections."""
