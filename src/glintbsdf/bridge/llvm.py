"""Choose the LLVM library that Dr.Jit loads.

Dr.Jit loads the LLVM named by the environment variable ``DRJIT_LIBLLVM_PATH`` or, where that is
not set, the first one it finds, as soon as it is imported. Versions 14 and 15 are still common and
make it abort the process at the first kernel ("Cannot select: fminimum"). This module finds the
newest library of at least :data:`MINIMUM_VERSION` and names it before that happens.

Versions come from file names, or from a separate process: two LLVMs in one process are
best avoided.

LLVM takes longer to compile a large kernel than a short test, a preview or the first step of an
optimisation takes to run it. With the environment variable ``GLINTBSDF_KERNELS`` set to ``quick``,
LLVM leaves out the passes that only make kernels faster. The numbers that kernels compute stay the
same.
"""

from __future__ import annotations

import ctypes
import glob
import os
import platform
import re
import shutil
import site
import subprocess
import sys
import sysconfig
from typing import NamedTuple

VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Name of the environment variable from which Dr.Jit reads the library's path."""

MINIMUM_VERSION = 16
"""Oldest major version with which Dr.Jit's kernels compile."""


QUICK_VARIABLE = "GLINTBSDF_KERNELS"
"""Name of the environment variable that asks for kernels that compile quickly."""

QUICK_OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=0", "-regalloc=fast")
"""Options of LLVM that leave out optional passes, say nothing of it, and allocate registers in one
pass."""

QUICK_MINIMUM_VERSION = 18
"""Oldest major version that is given these options. LLVM ends the process at an unknown one."""


class LLVMError(RuntimeError):
    """There is no LLVM on which Dr.Jit could run."""


class Library(NamedTuple):
    """An LLVM library: its version, most significant number first, and its path."""

    version: tuple[int, ...]
    path: str

    @property
    def usable(self) -> bool:
        """Whether Dr.Jit can compile with it."""
        return self.version[0] >= MINIMUM_VERSION


# ---------------------------------------------------------------------------------------------
#  Choice
# ---------------------------------------------------------------------------------------------


def choose() -> None:
    """Name the newest usable LLVM to Dr.Jit, unless one is named or loaded already.

    It is called when the package is imported. It does nothing if there is no usable library, as
    a program that runs on the GPU needs none, or if Dr.Jit was imported before and has made its
    choice. Then :func:`require_usable` raises an error where LLVM is needed.

    Raises:
        LLVMError: the environment variable ``GLINTBSDF_KERNELS`` is neither ``optimised`` nor
            ``quick``.
    """
    kernels = os.environ.get(QUICK_VARIABLE, "optimised")
    if kernels not in ("optimised", "quick"):
        raise LLVMError(f'{QUICK_VARIABLE} must be "optimised" or "quick" (got "{kernels}")')
    if "drjit" in sys.modules:
        return
    if VARIABLE not in os.environ:
        library = next((library for library in find() if library.usable), None)
        if library is None:
            return
        os.environ[VARIABLE] = library.path
    if kernels == "quick":
        compile_quickly(os.environ[VARIABLE])


def compile_quickly(path: str) -> None:
    """Have the LLVM library at ``path``, which Dr.Jit is about to load, compile quickly.

    Nothing changes if the library is too old to know how. Dr.Jit keeps compiled kernels on disk,
    and does not see how they were compiled. So these go to a folder ``quick`` of their own.
    """
    version = _version(path)
    if version is None or version[0] < QUICK_MINIMUM_VERSION:
        return
    folder = os.environ.get("DRJIT_CACHE_DIR", os.path.join(os.path.expanduser("~"), ".drjit"))
    if os.path.basename(folder) != "quick":  # that of the process which has started this one
        folder = os.path.join(folder, "quick")
    try:
        library = ctypes.CDLL(path)
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return
    os.environ["DRJIT_CACHE_DIR"] = folder
    arguments = [option.encode() for option in ("glintbsdf", *QUICK_OPTIONS)]
    library.LLVMParseCommandLineOptions(
        len(arguments), (ctypes.c_char_p * len(arguments))(*arguments), None
    )


def require_usable() -> None:
    """Raise :class:`LLVMError`, with the command that helps, unless Dr.Jit has a usable LLVM."""
    version = loaded_version()
    if _is_usable(version):
        return

    named = os.environ.get(VARIABLE)
    usable = next((library for library in find() if library.usable), None)
    if version is None and named:
        problem = f"Dr.Jit could not load the LLVM library named by {VARIABLE} ({named})"
    elif version is None:
        problem = "Dr.Jit found no LLVM library"
    else:
        problem = f"Dr.Jit has loaded LLVM {version[0]}" + (
            f" ({VARIABLE}={named})" if named else ""
        )
    if usable is None:
        remedy = f"Type: {install_command()}" + (f" && unset {VARIABLE}" if named else "")
    elif named:
        remedy = f"Before Python starts, type: export {VARIABLE}={usable.path}"
    else:
        # A library is there, but too late: Dr.Jit chooses its LLVM when it is imported.
        remedy = (
            "Import glintbsdf before mitsuba and drjit, or, before Python starts, "
            f"type: export {VARIABLE}={usable.path}"
        )
    raise LLVMError(f"{problem}, but version {MINIMUM_VERSION} or newer is needed. {remedy}")


def loaded_version() -> tuple[int, ...] | None:
    """Return the version of the LLVM that Dr.Jit has loaded, or None where it has none."""
    import drjit as dr

    version = dr.detail.llvm_version()
    return None if version[0] < 0 else version


def install_command() -> str:
    """Return the command that installs a usable LLVM on this kind of machine."""
    if sys.platform == "darwin":
        return "brew install llvm"
    if sys.platform == "win32":
        return "winget install LLVM.LLVM"
    if platform.machine() == "x86_64":
        return f"{sys.executable} -m pip install karellen-llvm-core"
    return "sudo apt install libllvm19"


def _is_usable(version: tuple[int, ...] | None) -> bool:
    return version is not None and version[0] >= MINIMUM_VERSION


# ---------------------------------------------------------------------------------------------
#  Search
# ---------------------------------------------------------------------------------------------


# libLLVM-15.so.1, libLLVM-14.0.6.so, libLLVM.so.23.1, libLLVM-19.dylib
_LIBRARY_NAME = re.compile(
    r"libLLVM(?:-(?P<version>\d+(?:\.\d+)*)\.(?:so(?:\.\d+)?|dylib)"
    r"|\.so\.(?P<suffix>\d+(?:\.\d+)+))"
)


def find() -> list[Library]:
    """Return the LLVM libraries of this Python environment and of the system, newest first."""
    paths = dict.fromkeys(os.path.realpath(path) for path in _candidates())
    libraries = [Library(version, path) for path in paths if (version := _version(path))]
    return sorted(libraries, key=lambda library: library.version, reverse=True)


def _candidates() -> list[str]:
    environment = [sysconfig.get_path("data"), sys.base_prefix, site.getuserbase()]
    if sys.platform == "win32":
        folders = [os.path.join(prefix, "Library", "bin") for prefix in environment]
        folders.append(r"C:\Program Files\LLVM\bin")
        names = ["LLVM-C.dll"]
    elif sys.platform == "darwin":
        folders = [os.path.join(prefix, "lib") for prefix in environment]
        folders += ["/opt/homebrew/opt/llvm*/lib", "/usr/local/opt/llvm*/lib", "/opt/local/lib"]
        names = ["libLLVM.dylib", "libLLVM-*.dylib"]
    else:
        folders = [os.path.join(prefix, "lib") for prefix in environment]
        folders += ["/usr/lib/llvm-*/lib", "/usr/lib/llvm/*/lib64", "/usr/local/lib"]
        names = ["libLLVM.so*", "libLLVM-*.so*"]
    patterns = [os.path.join(folder, name) for folder in folders for name in names]
    return [path for pattern in patterns for path in glob.glob(pattern)] + _linker_cache()


def _linker_cache() -> list[str]:
    """Return the LLVM libraries of this machine's architecture that Linux's linker knows."""
    search_path = os.pathsep.join([os.environ.get("PATH", ""), "/sbin", "/usr/sbin"])
    ldconfig = shutil.which("ldconfig", path=search_path)
    if ldconfig is None:
        return []
    listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
    architecture = {"x86_64": "x86-64", "aarch64": "AArch64"}.get(platform.machine(), "")
    return re.findall(rf"libLLVM[-.]\S+ \([^)]*{architecture}[^)]*\) => (\S+)", listing)


def _version(path: str) -> tuple[int, ...] | None:
    """Return the version of the library at ``path``, or None where it is not usable LLVM."""
    name = _LIBRARY_NAME.fullmatch(os.path.basename(path))
    if name is None:
        return _ask_version(path)
    return tuple(int(part) for part in (name["version"] or name["suffix"]).split("."))


def _ask_version(path: str) -> tuple[int, ...] | None:
    # LLVMGetVersion came with LLVM 16: a library that lacks it is too old.
    script = (
        "import ctypes, sys\n"
        "library = ctypes.CDLL(sys.argv[1])\n"
        "numbers = [ctypes.c_uint() for _ in range(3)]\n"
        "library.LLVMGetVersion(*map(ctypes.byref, numbers))\n"
        "print(*(number.value for number in numbers))\n"
    )
    answer = subprocess.run(
        [sys.executable, "-I", "-c", script, path], capture_output=True, text=True, check=False
    )
    return tuple(int(part) for part in answer.stdout.split()) or None
