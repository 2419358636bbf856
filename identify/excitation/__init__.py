"""Optimal experiment design: exciting trajectories."""
