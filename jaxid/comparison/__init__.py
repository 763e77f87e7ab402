"""Comparison of logs: is one machine behind all of them, and if not, what differs."""
