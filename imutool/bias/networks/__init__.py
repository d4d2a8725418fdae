"""Networks of the bias models in torch, for training; `frozen` gives the model."""
