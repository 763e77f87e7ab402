"""The search in the simulated control loop: trials of candidates by linearisation, then refits."""
