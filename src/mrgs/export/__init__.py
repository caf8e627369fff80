"""A baked model into files that other programs open."""
