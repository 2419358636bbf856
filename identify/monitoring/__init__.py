"""Repeated identification: history, change tests, the scheduled job and the worker."""
