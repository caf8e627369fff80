"""The colour residual ĉ."""
