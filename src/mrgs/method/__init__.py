"""The paper's method: configuration, camera model, losses, density control, start."""
