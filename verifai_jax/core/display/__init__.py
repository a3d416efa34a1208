"""The display of results: notebooks, figures, progress, names that are imported late."""
