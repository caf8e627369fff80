"""Poses from the images alone (structure from motion)."""

from mrgs.prepare.sfm.reconstruct import reconstruct

__all__ = ["reconstruct"]
