"""Check of the set-up before any other test: wiring, units, transmission, gravity, clocks."""
