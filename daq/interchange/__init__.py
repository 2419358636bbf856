"""Import and export of recordings in other formats."""
