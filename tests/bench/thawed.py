"""A model's weights in the network that trained them."""

from __future__ import annotations

import torch

from imutool import registry
from imutool.bias.model import BiasModel
from imutool.bias.networks.network import BiasNetwork


def thawed(model: BiasModel) -> BiasNetwork:
    """The network whose `frozen` a model is."""
    network: BiasNetwork = registry.load("imutool.networks", model.method).Network(model.config, model.rate_hz).double()
    network.load_state_dict({name: torch.from_numpy(value) for name, value in model.tensors.items()})
    return network.requires_grad_(False).eval()
