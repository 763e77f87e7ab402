"""Common parts of several estimators: least-squares solver, bounds, consistency, reruns."""
