"""Identification of the controller, for the auxiliary closed loop."""
