"""The web interface of a cell: it shows and asks; no fault of it touches a cycle."""
