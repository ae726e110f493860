"""Steppers: an algorithm one line at a time, with the line, a picture and the numbers of the plain
code as it ran."""
