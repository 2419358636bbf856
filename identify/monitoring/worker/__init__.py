"""The identification worker of a cell."""
