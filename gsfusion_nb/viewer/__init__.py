"""The splat viewer without a notebook: rows for the browser, places to look from, its front end,
and maps in pages of their own."""
