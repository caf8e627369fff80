"""The viewer in the browser: look at a run in colour and in °C, read points and boxes, compare with
the photos."""

from mrgs.viewer.server import LiveView, view

__all__ = ["LiveView", "view"]
