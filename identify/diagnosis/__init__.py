"""Diagnosis of effects that a model lacks, tested on held-out data."""
