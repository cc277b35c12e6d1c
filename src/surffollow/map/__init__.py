"""The map of the surface: grids, their update, and the ways to lay them anew."""
