"""Identities on the wire: certificates of a plant, where their keys are, signatures, and who may do what."""
