"""Algebraic estimators: iterated integrals over windows of a log."""
