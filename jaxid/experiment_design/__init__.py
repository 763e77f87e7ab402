"""Experiments that identify the unknowns best, within the limits of a machine."""
