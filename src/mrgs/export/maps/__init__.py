"""Orthographic maps in °C: from above, and of a façade."""
