"""The effects a rigid model with symmetric friction can lack, and the terms they add to it."""
