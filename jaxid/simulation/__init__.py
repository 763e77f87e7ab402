"""Simulation: control loops, solvers, step sizes, and replays of a log."""
