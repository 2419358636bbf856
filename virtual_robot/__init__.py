"""Virtual robot arm: a simulated plant behind CANopen drives, or a recording replayed through them."""
