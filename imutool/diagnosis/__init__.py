"""Which physics separates a recording from a simulation or from its own poses."""
