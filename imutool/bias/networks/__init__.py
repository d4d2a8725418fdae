"""Networks of the bias models in torch, for training; `Network.frozen` is the model for inference."""
