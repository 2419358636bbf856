"""Matching of received PDOs to their SYNC, and detection of gaps."""
