"""Results as JSON, as text, and as report pages."""
