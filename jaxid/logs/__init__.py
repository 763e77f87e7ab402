"""Logs: reading, time base, soundness checks, filtering."""
