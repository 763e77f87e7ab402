"""Output error under a prior, in the directions that a short log can identify."""
