"""Training: recordings to segments, a loss, and the loop that yields one `Epoch` at a time."""

from imutool.errors import not_installed

try:
    import torch
    import torchdiffeq
except ImportError as error:
    raise not_installed("PyTorch", "train", where="train", user="training, or noise in motion,") from error

del torch, torchdiffeq
