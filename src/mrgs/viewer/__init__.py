"""The viewer in the browser: a run in colour and °C, readings, and comparison with the photos."""

from mrgs.viewer.server import LiveView, view

__all__ = ["LiveView", "view"]
