"""Recordings: writing, reading, replay, conversion, figures, CSV logs."""
