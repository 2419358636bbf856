"""The suite of a diagnosis: effects hidden in virtual arms, and how often they are found by name."""
