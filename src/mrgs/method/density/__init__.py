"""Adaptive density control: where Gaussians are added, moved and removed during training."""
