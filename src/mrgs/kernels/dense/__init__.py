"""Linear layers over blocks of rows, from which the heads are made."""
