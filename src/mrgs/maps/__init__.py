"""Orthographic maps of a model: a façade from the front, or a scene from above, in °C."""
