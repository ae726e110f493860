"""Sliders beside a picture, one panel per step of the method."""
