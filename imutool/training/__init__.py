"""Training: recordings to segments, a loss, and the loop that yields one `Epoch` at a time."""

from importlib.util import find_spec

from imutool.errors import not_installed

try:
    import torch
except ImportError as error:
    raise not_installed("PyTorch", "train", where="train", user="training, or noise in motion,") from error
if find_spec("torchdiffeq") is None:  # imported where an ODE is solved
    raise not_installed("torchdiffeq", "train", where="train", user="training")

del torch
