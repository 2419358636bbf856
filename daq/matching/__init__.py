"""Assignment of received PDOs to their SYNC, and gaps."""
