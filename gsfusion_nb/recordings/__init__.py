"""Recordings that others made: their check-up, conversion from other formats, and downloads."""
