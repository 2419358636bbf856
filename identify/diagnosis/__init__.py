"""Where model and data disagree, what is missing, and whether adding it closes the gap on unseen data."""
