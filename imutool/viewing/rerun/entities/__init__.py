"""What is logged to Rerun, one kind of entity a file."""
