"""Pictures, graphs and HTML pages from arrays and numbers. Every room that shows something draws with this one."""
