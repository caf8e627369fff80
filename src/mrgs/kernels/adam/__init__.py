"""Adam's step of one tensor."""
