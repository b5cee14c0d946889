"""The tests mirror the folders of the package; some share the scenes of others."""
