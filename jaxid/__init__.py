"""jaxid: identify machines with friction, and find the physics that a simulation is missing."""

from jaxid import _platform

_platform.configure()
