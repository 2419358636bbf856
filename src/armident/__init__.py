"""Records robot arms over CANopen and identifies, diagnoses and monitors their dynamic models."""
