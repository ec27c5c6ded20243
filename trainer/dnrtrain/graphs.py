"""Networks as CUDA graphs: one launch for what is a hundred small kernels.

On a small picture a training step is not arithmetic but the launching of kernels, one by one, by one processor core.
A graph records them once, forward and backward, and launches them together (torch.cuda.make_graphed_callables). It
holds for inputs of one shape; weights may change in place, as optimisers and `load_state_dict` do.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

MOST_PIXELS = 1 << 17
"""Larger pictures keep the GPU busy by themselves, and a graph keeps the memory that it was recorded with."""
MOST_GRAPHS = 2
"""Of one network: a picture and the same one turned by a right angle."""


class Graph:
    """A network in training that is recorded once for each shape of its inputs, up to MOST_GRAPHS.

    What a graph returns is overwritten by its next call: the backward pass must come before that. So calls without
    gradients, larger inputs and those on a CPU go to the network itself.

    Args:
        weights: the module whose parameters ``network`` uses.
        network: tensors [N, C, H, W], and options that a graph is recorded with -> a tensor.
    """

    def __init__(self, weights: nn.Module, network: Callable[..., Tensor]) -> None:
        self._weights, self._network = weights, network
        self._graphs: dict[object, Callable[..., Tensor]] = {}

    def __call__(self, *inputs: Tensor, **options: Hashable) -> Tensor:
        """``network(*inputs, **options)``."""
        key = (tuple((tensor.shape, tensor.requires_grad) for tensor in inputs), tuple(options.items()))
        if not _pays(inputs) or (key not in self._graphs and len(self._graphs) == MOST_GRAPHS):
            return self._network(*inputs, **options)
        if key not in self._graphs:
            samples = tuple(tensor.detach().clone().requires_grad_(tensor.requires_grad) for tensor in inputs)
            recorded = _Recorded(self._weights, partial(self._network, **options))
            if hasattr(torch.autograd.graph, "set_warn_on_accumulate_grad_stream_mismatch"):  # from torch 2.11 on
                # Gradients come from the stream that recorded; autograd waits for it, and would say so each time.
                torch.autograd.graph.set_warn_on_accumulate_grad_stream_mismatch(False)
            with torch.cuda.device(inputs[0].device):  # it records the current one
                graph: Any = torch.cuda.make_graphed_callables(recorded, samples, allow_unused_input=True)
            self._graphs[key] = graph
        return self._graphs[key](*inputs)


class _Recorded(nn.Module):
    """What torch records: a module of its own, whose ``forward`` recording replaces."""

    def __init__(self, weights: nn.Module, network: Callable[..., Tensor]) -> None:
        super().__init__()
        self.weights, self.network = weights, network

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.network(*inputs)


def _pays(inputs: tuple[Tensor, ...]) -> bool:
    small = all(tensor.is_cuda and tensor.numel() // tensor.shape[1] <= MOST_PIXELS for tensor in inputs)
    return small and torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)
