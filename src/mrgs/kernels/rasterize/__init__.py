"""Alpha blending of projected Gaussians."""
