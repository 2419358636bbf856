"""Identification, diagnosis, comparison and trajectory design; `armident` gives their names to a user."""
