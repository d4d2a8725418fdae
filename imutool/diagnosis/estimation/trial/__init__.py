"""Trial of the chosen effects: on time that no fit has seen, and against a bias that walks."""
