"""MIP-mapped lobes of a synthesised map (Tan et al. 2022)."""
