"""Files of every format as columns."""
