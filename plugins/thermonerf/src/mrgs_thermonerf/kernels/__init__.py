"""CPU kernels of the field's operations, registered where the operations are defined."""
