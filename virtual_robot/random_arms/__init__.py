"""Random arms with hidden effects: plants of the suite ``armident diagnose-suite --arms random``."""
