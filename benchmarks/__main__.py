"""``python -m benchmarks NAME``: a group of commands, each of which is imported when it runs."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import NoReturn

import click

#: Modules of ``benchmarks.commands``; each has a command of its own name.
COMMANDS = (
    "error_vs_time",
    "convergence",
    "stability",
    "accuracy",
    "cost",
    "front",
    "gpu",
    "projected_area",
    "energy",
    "mip",
    "grid",
    "separation",
    "inverse",
)


class Benchmarks(click.Group):
    """The group of all :data:`COMMANDS`."""

    def list_commands(self, context: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        return getattr(import_module(f"benchmarks.commands.{name}"), name)


def add(_context: click.Context, _option: click.Parameter, modules: tuple[str, ...]) -> None:
    """Import plugins before a command is imported, which takes its methods from the register."""
    if modules:
        import mitsuba as mi

        from glintbsdf.bridge import registration

        mi.set_variant("llvm_ad_rgb")
        for module in modules:
            registration.add_plugins(module)


@click.group(cls=Benchmarks, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--method", multiple=True, metavar="MODULE", callback=add, expose_value=False,
              help="Module with a P-NDF of your own, which is compared as well.")  # fmt: skip
def benchmarks() -> None:
    """Measure glintbsdf. Each command prints tables; its help says what was expected.

    With -o, results are written to a folder, as JSON and images, and a command that was interrupted
    continues there. Caches on disk are not used, as building and compiling are timed.
    """


@contextmanager
def fresh_caches() -> Iterator[None]:
    """A context without the caches on disk that earlier processes have written.

    Dr.Jit and glintbsdf read the environment when they are imported, which must happen later.
    """
    with tempfile.TemporaryDirectory() as kernels:
        os.environ |= {"GLINTBSDF_CACHE": "off", "DRJIT_CACHE_DIR": kernels}
        yield


def run() -> NoReturn:
    """Run the command line. The exit status is 1 if it was interrupted."""
    from glintbsdf.core.interruption import interruptible

    try:
        with interruptible():
            status = benchmarks.main(prog_name="python -m benchmarks", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        sys.exit("Interrupted. With -o, the same command goes on from here.")
    sys.exit(status if isinstance(status, int) else 0)


if __name__ == "__main__":
    with fresh_caches():
        run()
