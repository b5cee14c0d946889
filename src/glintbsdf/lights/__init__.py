"""Lights of a scene that are integrated instead of sampled."""
