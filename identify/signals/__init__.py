"""Signals: smoothing, differentiation and decimation of what was measured."""
