"""``python -m glintbsdf``: the command line."""

from glintbsdf.cli.main import main

main()
