"""A prepared log held against its case, before any fit: sign of the force, noise, hold, control law."""
