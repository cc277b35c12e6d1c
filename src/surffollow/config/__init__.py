"""Configuration files, parameters with their bounds, names and limits."""
