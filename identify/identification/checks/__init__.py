"""Checks of an identification: each takes its parts and the criteria, and returns reasons for the verdict."""
