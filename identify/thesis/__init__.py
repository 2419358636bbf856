"""The thesis's tables, computed anew beside its figures."""
