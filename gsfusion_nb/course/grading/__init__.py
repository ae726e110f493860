"""Marks for a class: every submission runs in a process of its own, without the solutions, and is
judged in another."""
