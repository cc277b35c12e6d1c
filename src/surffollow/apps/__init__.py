"""Applications: the demonstration and its picture, scans, shared robots."""
