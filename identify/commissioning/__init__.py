"""Commissioning: a new arm from a configuration to a trusted model, by motions that grow."""
