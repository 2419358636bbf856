"""Faults of recorded signals that are seen without a model: each kind is a class that finds it, in one module."""
