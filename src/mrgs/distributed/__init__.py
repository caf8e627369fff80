"""Several processes that work together, started by PyTorch's own ``torchrun``: who they are, what
they exchange, and what they share out among themselves."""
