"""Scheduled re-identification: excite, record, identify, and test for change since the baseline."""
