"""How processor time and memory of a training grow, and what is printed of the memory before it."""
