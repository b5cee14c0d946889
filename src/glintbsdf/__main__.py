"""``python -m glintbsdf``: the command line."""

from .cli import main

main()
