"""Scenes that are too large for one training: a coarse model of everything, blocks that refine a
part of it each, and one model joined from them."""
