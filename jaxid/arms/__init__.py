"""Inertial parameters of linkages: base parameters, physical consistency, the dominant inertia."""
