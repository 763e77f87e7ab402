"""Numerical tools independent of any machine: smooth functions, filters, precision, batched calls."""
