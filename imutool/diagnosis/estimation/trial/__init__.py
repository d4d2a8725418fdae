"""Trial of the chosen effects: on unseen time, against a walk and the errors of models."""
