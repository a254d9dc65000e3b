"""Compiling what a script calls again and again: what ``compile=true`` asks for."""

from __future__ import annotations

from torch import nn

from torchrl_ecpo.checks import check_kind

__all__ = ["compile_module"]


def compile_module(module: nn.Module, name: str) -> None:
    """Compile a module in place with ``torch.compile``, for the same numbers in less time.

    Nothing else about the module changes: parameters, state dict and what holds it stay as they
    are; a copy of it is not compiled. Random numbers are those that it draws uncompiled. On a CPU
    inductor generates C++ code, which needs a compiler; on a GPU it records CUDA graphs (untried).

    The first call compiles, forward and backward pass, and takes from ten seconds to two minutes;
    a call with inputs of another kind or shape compiles again.

    Args:
        module: whose calls are compiled, not those of its methods.
        name: of the module, in the message that the first call takes long.

    Examples:
        >>> import torch
        >>> from torchrl_ecpo.experiment import compile_module
        >>> network = torch.nn.Linear(3, 2)
        >>> compile_module(network, "network")
        The first call of the network compiles it, which may take some minutes
        >>> list(network.state_dict())
        ['weight', 'bias']
    """
    check_kind("module", module, nn.Module)
    on_gpu = any(parameter.is_cuda for parameter in module.parameters())
    module.compile(options={"fallback_random": True, "triton.cudagraphs": on_gpu})
    print(f"The first call of the {name} compiles it, which may take some minutes", flush=True)
