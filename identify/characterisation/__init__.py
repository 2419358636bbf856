"""Friction over speed, torque ripple, presliding and play of one joint that moves alone."""
