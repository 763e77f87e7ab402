"""Output error under a prior, in the subspace of unknowns that a short log identifies."""
