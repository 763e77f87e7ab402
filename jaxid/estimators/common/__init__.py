"""Parts that several estimators share: least-squares solver, bounds, consistency, reruns."""
