"""Logs in the Rerun viewer: entities, layouts, and outputs to a viewer, a file or a page."""
