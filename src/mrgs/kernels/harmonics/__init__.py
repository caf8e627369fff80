"""Spherical harmonics seen from a camera."""
