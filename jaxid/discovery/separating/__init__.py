"""Experiments that separate effects which a log cannot tell apart."""
