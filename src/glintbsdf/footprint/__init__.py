"""The footprint of a pixel: its Gaussian, kernels on the lattice of texels, ray cones."""
