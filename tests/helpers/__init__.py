"""What the tests share, as plain functions and classes."""
