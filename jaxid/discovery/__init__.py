"""Finding the physics that a simulation is missing."""
