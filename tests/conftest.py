"""float64 and the loop flag, before any test module starts JAX; commands keep nothing on disk."""

import os

import jaxid as jaxid

os.environ["JAXID_CACHE"] = "off"
