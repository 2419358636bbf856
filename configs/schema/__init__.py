"""Pydantic models of all kinds of configuration files."""
