"""Monte-Carlo studies: a case simulated and identified many times."""
