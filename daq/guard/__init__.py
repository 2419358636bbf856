"""The guard: a process that monitors a moving arm on its bus, and stops the drives within one cycle."""
