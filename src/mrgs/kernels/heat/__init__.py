"""The temperature residual t̂."""
