"""Evaluation of the diagnosis on simulated recordings with known effects: ``armident diagnose-suite``."""
