"""The command line ``glintbsdf``."""

from glintbsdf.cli.entry import commands, main

__all__ = ["commands", "main"]
