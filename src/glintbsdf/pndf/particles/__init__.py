"""Facets as points in position × normal space: constant time, no map, no memory."""
