"""The pydantic models of every kind of configuration file."""
