"""The robot model: serial chains from MDH, base parameters, closed-loop simulation."""
