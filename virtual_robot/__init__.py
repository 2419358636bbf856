"""The stand-in arm: a plant behind CANopen drives, or a measured recording replayed through them."""
