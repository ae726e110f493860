"""What is applied to a sequence after it is read: selection, size, depth limits, corrections."""
