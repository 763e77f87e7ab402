"""Experiments that separate effects that a log cannot distinguish."""
