"""Minimal identification models: a plant's linear balance without the motion that nobody measured."""
