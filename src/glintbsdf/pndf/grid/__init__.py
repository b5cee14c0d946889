"""Procedural microdetails on multiscale grids (Zirr and Kaplanyan 2016)."""
