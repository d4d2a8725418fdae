"""Initial bias of a run, and its tracking from there."""
