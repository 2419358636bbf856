"""Reproduction of the tables of M. Brunot's thesis (Toulouse, 2017)."""
