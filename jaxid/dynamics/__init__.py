"""Readings of the balance: right-hand side, dry-friction step, residuals, hidden joints."""
