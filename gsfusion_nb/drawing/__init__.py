"""Pictures, graphs and HTML pages from arrays and numbers. All other rooms draw with this one."""
