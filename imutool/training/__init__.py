"""Training: recordings to segments, a loss, and the loop that yields one `Epoch` at a time."""

from imutool.errors import ConfigError

try:
    import torch
    import torchdiffeq
except ImportError as error:
    raise ConfigError(
        "training and noise in motion need PyTorch, which is not installed",
        where="train",
        fix="Install it with: pip install 'imutool[train]'",
    ) from error

del torch, torchdiffeq
