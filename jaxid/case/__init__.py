"""Case files: the schema of every table, and the values, effects and sensors that a case declares."""
