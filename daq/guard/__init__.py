"""The guard: a process that watches a moving arm on its bus, and stops the drives within one cycle."""
