"""float64 and the loop flag, before any test module starts JAX."""

import jaxid as jaxid
