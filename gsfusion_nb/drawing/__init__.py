"""Pictures, graphs and HTML pages from arrays and numbers, for all other parts of the package."""
