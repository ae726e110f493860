"""The web book: the notebooks and the documentation as a site of files that needs no server and no network."""
