"""How sealed cases are made: a handwriting of its own, which knows nothing of the effects that `diagnose` fits."""
