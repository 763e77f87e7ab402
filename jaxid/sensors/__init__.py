"""Sensors: encoders with resolution and noise, gyroscopes and accelerometers."""
