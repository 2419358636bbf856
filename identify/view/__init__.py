"""Recordings and their unexplained torques in 3D viewers: Rerun and Foxglove."""
