"""One statement of the physics: parameters, effects, and the balance of a plant."""
