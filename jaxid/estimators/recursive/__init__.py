"""Recursive least squares with forgetting, sample by sample."""
