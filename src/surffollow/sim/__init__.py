"""Simulated surfaces, plants, robots, arms and bases."""
