"""The bias a run starts with, and how it is tracked from there."""
