"""What every floor stands on: errors, the cache on disk, progress, random numbers."""
