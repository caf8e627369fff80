"""The Gaussians at step 0: start points, their colours and their temperatures."""
