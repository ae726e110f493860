"""Readers of recordings on disk, one file per layout.

A new reader is one new file here: a function that reads a folder, and ``LAYOUT``, which says how to
recognise one. The name of the file is the name of the layout, which ``open_sequence``, the command
line and the check of a recording then know. Layouts are tried in alphabetical order; the first
whose files are all there is taken.
"""
