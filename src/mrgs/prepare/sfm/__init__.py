"""Poses from the images alone (structure from motion)."""
