"""Position-normal Gaussian elements (Yan, Hašan, Marschner and Ramamoorthi 2016)."""
