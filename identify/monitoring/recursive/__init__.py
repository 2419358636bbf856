"""Recursive identification on the live stream: parameters as a random walk, and a sequential test of friction."""
