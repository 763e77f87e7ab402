"""Monte-Carlo studies: a case simulated and identified over and over."""
