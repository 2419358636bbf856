"""Acquisition: samples from the bus to recordings and streams, and the root of the command line."""
