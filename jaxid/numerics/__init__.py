"""Numerical tools that know no machine: smooth functions, filters, precision, batched calls."""
