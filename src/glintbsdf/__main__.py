"""``python -m glintbsdf``: the command line."""

from glintbsdf.cli import main

main()
