"""Configurations from what is known of an arm: URDF, Denavit-Hartenberg table, library, and a recording."""
