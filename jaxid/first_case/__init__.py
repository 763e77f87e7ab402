"""A first case from a raw log: columns by their names, units, and rough guesses of the unknowns."""
