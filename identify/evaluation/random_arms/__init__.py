"""Suite of random arms: ``armident diagnose-suite --arms random``."""
