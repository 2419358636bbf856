"""Changes of an arm between two identifications, and their history."""
