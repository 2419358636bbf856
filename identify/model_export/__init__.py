"""Export of an identified model to the formats of simulators and control software."""
