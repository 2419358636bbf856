"""Catalogue of effects beyond a rigid model with symmetric friction, and the model terms that they add."""
