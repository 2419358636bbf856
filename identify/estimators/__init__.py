"""Estimators of the thesis, each a short function over shared pieces."""
