"""The capture daemon: from the bus to recordings and Zenoh."""
