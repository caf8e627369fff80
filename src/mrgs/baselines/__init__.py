"""Methods that MrGS is compared with."""
