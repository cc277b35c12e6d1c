"""The simulated sensors: beam, LED triangulation, A/D converter, and source of the pose."""
