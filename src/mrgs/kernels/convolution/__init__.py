"""The 3 × 3 convolution of the depth's uncertainty."""
