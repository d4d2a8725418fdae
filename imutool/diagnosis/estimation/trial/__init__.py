"""Trial of the chosen effects: on unseen time, against a bias that walks and the errors of models."""
