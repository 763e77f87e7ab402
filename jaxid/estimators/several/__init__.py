"""Estimators that fit one set of unknowns to several logs, each log weighed by its noise."""
