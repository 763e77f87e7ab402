"""Logs of the exact axis, as the package takes them."""

from jaxid.logs.log import Log
from truth.axis.cases import recorded
from truth.axis.machines import Setup


def log_of(setup: Setup, **changes) -> Log:
    """Simulate a setup, and return the log that a user would have."""
    return Log(**recorded(setup, **changes))
