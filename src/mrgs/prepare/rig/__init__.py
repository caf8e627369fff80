"""Calibration of the thermal camera relative to the RGB camera: intrinsics, distortion and
extrinsics, with or without a target."""
