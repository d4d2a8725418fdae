"""References of a recording that are its own: true poses."""
