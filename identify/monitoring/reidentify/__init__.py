"""The scheduled job: excite an arm, record it, identify it, and say whether it has changed since its baseline."""
