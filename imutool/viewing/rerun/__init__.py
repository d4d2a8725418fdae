"""Logs in the Rerun viewer: what is logged, how it is laid out, and the ways to a viewer, a file or a page."""
