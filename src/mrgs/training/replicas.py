"""The model is the same on all processes of a training, also where their machines round
differently."""

from __future__ import annotations

import torch
from jaxtyping import Int64
from torch import Tensor

from mrgs.distributed.processes import Processes
from mrgs.training.checkpoint import tensors_of
from mrgs.training.state import TrainingState


@torch.no_grad()
def align_replicas(processes: Processes, state: TrainingState) -> bool:
    """Replace the state by the first process's where any two differ.

    All processes add the same gradients, but on processors of different kinds Adam's last bit may
    differ, and density control might then decide differently.

    Args:
        processes: that train together, each with as many Gaussians.
        state: of this process; changed in place.

    Returns:
        whether they did differ.

    Raises:
        LinkError, PeerError: another process is gone.
    """
    tensors = tensors_of(state)
    own = torch.stack([_checksum(tensor) for tensor in tensors.values()])
    first, *others = processes.gather_tensors(own)
    if all(torch.equal(first, other) for other in others):
        return False
    for name, shared in processes.share_tensors(tensors).items():
        tensors[name].copy_(shared)
    return True


def _checksum(tensor: Tensor) -> Int64[Tensor, ""]:
    """A sum of all bits, four bytes at a time."""
    flat = tensor.detach().contiguous().flatten()
    bits = flat.view(torch.int32) if flat.element_size() == 4 else flat
    return bits.sum(dtype=torch.int64).cpu()
