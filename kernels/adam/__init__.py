"""One step of Adam on every row of a map, or of one parameter."""
