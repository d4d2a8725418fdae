"""Data of a view, free of any viewer."""
