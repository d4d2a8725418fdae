"""English sentences of a diagnosis, from its report alone."""
