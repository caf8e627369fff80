"""A chessboard that both cameras see: detected, located in space, and used in the calibration."""
