"""Common base of all other packages: errors, the cache on disk, progress, random numbers."""
