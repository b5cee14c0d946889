"""Rendering of units by many processes, on one or on many machines, through Dask.

The client sends a worker a unit and the description of its image. The worker checks that its
versions are the same, and says which files of the scene it lacks. It loads the scene once, and
returns the sums of the unit. The client submits only as many units as keep the workers busy, so the
memory of client and scheduler does not grow with the number of units. If a worker dies, Dask gives
its units to others. The image does not depend on which worker rendered a unit.

Workers run whatever their scheduler sends. So everybody who can reach the scheduler can do what the
workers can. A local cluster listens on loopback only; across machines use TLS.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import pickle
import signal
import threading
import time
import uuid
import warnings
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.scene.inspection import Inspected, Trimmed
from glintbsdf.scene.merging import Results
from glintbsdf.scene.package import (
    BadPackage,
    Content,
    Job,
    Store,
    pieces,
    version_difference,
    versions,
)
from glintbsdf.scene.passes import Tile
from glintbsdf.scene.rendering import Renderer
from glintbsdf.scene.units import Unit

if TYPE_CHECKING:
    from distributed import Client, Future
    from distributed.scheduler import KilledWorker

#: Seconds within which a scheduler must answer.
TIMEOUT = 8.0

#: Number of submitted units per worker: one that it renders, and one that waits.
UNITS_PER_WORKER = 2

#: Number of scenes that a worker keeps loaded: this one and the next frame of a sequence.
SCENES = 2

#: Environment variable with the number of rendering threads of a worker, if it is not Dask's
#: number.
THREADS = "GLINTBSDF_THREADS"

#: How many times a unit that needs too much memory may be halved.
HALVINGS = 2

#: How many times a unit is submitted again after the death of a worker, unless Dask knows that the
#: worker ran out of memory. Each time, Dask itself retries at least once.
TRIALS = 2


GONE = "the scheduler is gone; with --checkpoint the same command goes on from what is done"


class ClusterError(RuntimeError):
    """The scheduler or a worker has failed; the message says how."""


# ------------------------------------------------------------------------------------------------
#  On a worker
# ------------------------------------------------------------------------------------------------

_lock = threading.RLock()  # a process has one variant of Mitsuba and one pool of threads
_loaded: OrderedDict[Job, tuple[Renderer, ExitStack]] = OrderedDict()


@atexit.register
def _forget(kept: int = 0) -> None:
    """Free the loaded scenes except for the last ``kept``; at exit all, before Mitsuba is gone."""
    while len(_loaded) > kept:
        _loaded.popitem(last=False)[1][1].close()
    gc.collect()  # scenes and their plugins refer to each other


@dataclass(frozen=True)
class Answer:
    """The result of a worker for a unit.

    Attributes:
        worker (str): address of the worker.
        missing (tuple[Content, ...]): files that the worker lacks; there is no result then.
        tile, sums: the result of :func:`.sums_of_samples` for the unit.
        trimmed_too_far (bool): whether trimmed structures did not suffice, and were built in full.
    """

    worker: str
    missing: tuple[Content, ...] = ()
    tile: Tile | None = None
    sums: np.ndarray | None = None
    trimmed_too_far: bool = False

    @property
    def part(self) -> tuple[Tile, np.ndarray]:
        """Tile and sums of the unit; no file may have been missing."""
        if self.tile is None or self.sums is None:
            raise ValueError("the worker has not rendered the unit: files were missing")
        return self.tile, self.sums


class _Call:
    """An object whose unpickling calls a function."""

    def __init__(self, function: Callable, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable, tuple]:
        return self.call


def packed(job: Job, unit: Unit) -> bytes:
    """A task for Dask, whose unpickling runs :func:`work`.

    A worker without this package, or with another version, can receive these bytes and fail with a
    clear message. A task that it cannot unpickle at all would end one worker after the other.
    """
    return pickle.dumps(_Call(work, versions(), pickle.dumps((job, unit))))


def work(expected: dict[str, str], task: bytes) -> Answer:
    """Render a unit, on a worker.

    Args:
        expected: the versions that the worker must have.
        task: the pickled job and unit.

    Raises:
        ClusterError: the worker has other versions, or cannot run the variant.
        MemoryError: the worker has too little memory.
    """
    from distributed import get_worker

    worker = get_worker()
    difference = version_difference(expected)
    if difference is not None:
        raise ClusterError(f"the worker {worker.address} has {difference}")
    job, unit = pickle.loads(task)
    with _lock, _without_collection():
        store = Store(Path(worker.local_directory) / "glintbsdf-files")
        missing = job.package.missing(store) if job not in _loaded else []
        if missing:
            return Answer(worker.address, tuple(missing))
        try:
            threads = int(os.environ.get(THREADS) or worker.state.nthreads)
            renderer = _renderer(job, store, threads)
            tile, sums = renderer.render(unit)
        except Exception as error:
            if "out of memory" in str(error).lower() and not isinstance(error, MemoryError):
                raise MemoryError(str(error)) from None
            raise
        return Answer(
            worker.address, (), tile, sums, trimmed_too_far=not renderer_sufficed(renderer)
        )


def renderer_sufficed(renderer: Renderer) -> bool:
    """Whether the trimmed structures of a renderer have sufficed so far; true without trimming."""
    trimmed = getattr(renderer.missed, "__self__", None)
    return not isinstance(trimmed, Trimmed) or trimmed.sufficed


def _renderer(job: Job, store: Store, threads: int) -> Renderer:
    """The renderer of a job, whose scene is loaded with its first unit."""
    if job in _loaded:
        _loaded.move_to_end(job)
        return _loaded[job][0]
    if job.variant not in mi.variants():
        raise ClusterError(f"a worker's Mitsuba has no variant {job.variant}")
    if mi.variant() != job.variant:
        _forget()
    _forget(SCENES - 1)
    if job.variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise ClusterError(f"{job.variant} needs an NVIDIA GPU, and a worker has none")
    if mi.variant() != job.variant:
        mi.set_variant(job.variant)
    with _spare_thread(threads):
        scene = job.package.load(store, deferred=job.trim, glint_path=job.glint_path)
        missed = (
            Trimmed(Inspected.of(scene), job.spp, job.sensor).missed if job.trim else lambda: False
        )
    with ExitStack() as stack:
        renderer = stack.enter_context(Renderer(scene, job.spp, job.denoise, missed, job.sensor))
        _loaded[job] = renderer, stack.pop_all()
    return renderer


@contextlib.contextmanager
def _without_collection() -> Iterator[None]:
    """A context without garbage collection. Otherwise another thread of Dask may destroy a former
    scene while this one records a kernel, and Dr.Jit calls shapes that are half destroyed."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextlib.contextmanager
def _spare_thread(threads: int) -> Iterator[None]:
    """A context in which Dr.Jit has at least two threads, as Mitsuba needs them to read OpenEXR
    files. After it, Dr.Jit has ``threads`` threads."""
    dr.set_thread_count(max(2, threads))
    try:
        yield
    finally:
        dr.set_thread_count(threads)


def dask_setup(worker: object) -> None:
    """Ignore Ctrl-C; Dask calls this in each process of a local cluster. A terminal sends Ctrl-C to
    all processes, but only the client decides what to do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def receive(content: Content, offset: int, piece: bytes, last: bool, dask_worker=None) -> None:
    """Receive a piece of a file, on a worker. See :meth:`.Store.receive`."""
    Store(Path(dask_worker.local_directory) / "glintbsdf-files").receive(
        content, offset, piece, last
    )


# ------------------------------------------------------------------------------------------------
#  At the client
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Keys:
    """Files for TLS: the certificates of the authority and of this client, and its private key."""

    ca_file: Path
    cert: Path
    key: Path


class Cluster:
    """A connection to a Dask scheduler and its workers; a context manager.

    Use :meth:`local` or :meth:`at`.
    """

    client: Client  # within the block

    def __init__(self, open_client: Callable[[ExitStack], Client], tell: Callable[[str], None]):
        self._open_client, self._tell = open_client, tell
        self._stack = ExitStack()

    @classmethod
    def local(
        cls,
        workers: int,
        memory_limit: str = "auto",
        variant: str = "",
        tell: Callable[[str], None] = warnings.warn,
    ) -> Cluster:
        """Processes on this machine that share its cores. Other machines cannot reach them.

        Args:
            workers: number of processes.
            memory_limit: memory that each process may use, such as ``4GB``; a process that uses
                more is ended. ``auto``: its part of the machine's memory.
            variant: variant of Mitsuba; with CUDA each worker gets one GPU.
            tell: function that is called with messages for the user.
        """

        def open_client(stack: ExitStack) -> Client:
            import dask
            from distributed import Client, Nanny, Scheduler, SpecCluster

            threads = max(1, core_count() // workers)
            gpus = visible_gpus() if variant.startswith("cuda") else []

            def environment(number: int) -> dict[str, str]:
                own = {THREADS: str(threads)}
                return {**own, "CUDA_VISIBLE_DEVICES": gpus[number % len(gpus)]} if gpus else own

            loopback = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
            spec = {
                number: {
                    "cls": Nanny,
                    "options": {
                        "host": "127.0.0.1",
                        "dashboard_address": "127.0.0.1:0",
                        "nthreads": 1,  # units at a time
                        "memory_limit": memory_limit,
                        "preload": [__name__],
                        "silence_logs": "CRITICAL",
                        "env": environment(number),
                    },
                }
                for number in range(workers)
            }
            stack.enter_context(dask.config.set(_LOCAL_SETTINGS))
            cluster = stack.enter_context(
                SpecCluster(
                    workers=spec,
                    scheduler={"cls": Scheduler, "options": loopback},
                    silence_logs="CRITICAL",
                )
            )
            return stack.enter_context(Client(cluster, timeout=60))

        return cls(open_client, tell)

    @classmethod
    def at(
        cls,
        address: str,
        keys: Keys | None = None,
        tell: Callable[[str], None] = warnings.warn,
    ) -> Cluster:
        """The workers of a running scheduler.

        Args:
            address: for example ``tcp://host:8786`` or ``tls://host:8786``; the scheme may be left
                out.
            keys: files for TLS.
            tell: function that is called with messages for the user.

        Raises:
            ClusterError: the address is wrong; or, when the context is entered, no scheduler
                answers, or its workers have another version.
        """
        scheme, separator, rest = address.rpartition("://")
        scheme = scheme if separator else ("tls" if keys else "tcp")
        if scheme not in ("tcp", "tls"):
            raise ClusterError(f'the address of a scheduler is tcp:// or tls:// (got "{address}")')
        if (scheme == "tls") != (keys is not None):
            raise ClusterError(
                f"{scheme}://{rest} and TLS do not go together: "
                + ("give its three files" if scheme == "tls" else "the address must be tls://")
            )

        def open_client(stack: ExitStack) -> Client:
            from distributed import Client
            from distributed.security import Security

            security = keys and Security(
                tls_ca_file=str(keys.ca_file),
                tls_client_cert=str(keys.cert),
                tls_client_key=str(keys.key),
                require_encryption=True,
            )
            if keys is None and not _is_loopback(rest):
                tell(
                    f"{rest} is reached without TLS: whoever is on the way can read the scene and "
                    "run programs on the workers. See --tls-ca-file."
                )
            return stack.enter_context(
                Client(f"{scheme}://{rest}", timeout=TIMEOUT, security=security)
            )

        return cls(open_client, tell)

    def __enter__(self) -> Cluster:
        import asyncio
        import logging

        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        with ExitStack() as stack:
            try:
                self.client = self._open_client(stack)
            except (OSError, TimeoutError, asyncio.TimeoutError, ValueError) as error:
                raise ClusterError(f"no scheduler answers: {error}") from error
            self._check_versions()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def _check_versions(self) -> None:
        """Raise :class:`ClusterError` unless all workers have this package, in these versions."""
        import importlib.metadata

        # A worker without this package could not unpickle a function of this package.
        installed = self.client.run(importlib.metadata.version, "glintbsdf", on_error="return")
        for address, answer in installed.items():
            if isinstance(answer, Exception):
                raise ClusterError(f"the worker {address} has no glintbsdf: install it there")
        answers = self.client.run(version_difference, versions(), on_error="return")
        for address, answer in answers.items():
            if isinstance(answer, Exception):
                raise ClusterError(f"the worker {address} cannot use its glintbsdf: {answer}")
            if answer is not None:
                raise ClusterError(f"the worker {address} has {answer}")

    @property
    def worker_count(self) -> int:
        """Number of workers at the moment."""
        return len(self.client.nthreads())

    def __str__(self) -> str:
        count = self.worker_count
        return f"{count} worker" + ("s" if count != 1 else "")

    def render_all(self, job: Job) -> Callable[[Iterator[Unit]], Results]:
        """A function that renders units of a job, for :func:`~glintbsdf.scene.rendering.produce`.

        Raises:
            ClusterError: while the results are iterated: the scheduler is gone, a worker has
                another version, or no worker has enough memory for a unit.
        """
        return lambda units: _Rendering(self, job).results(units)


#: Settings of Dask for a local cluster. Memory is for rendering, not for results. A worker is not
#: dead only because a kernel takes long.
_LOCAL_SETTINGS = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.scheduler.allowed-failures": 1,
    # Units wait at the scheduler, not at workers: Dask would suspect them of a worker's death.
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.scheduler.worker-ttl": None,
    "distributed.admin.tick.limit": "1h",
}


@dataclass(frozen=True)
class _Task:
    """A submitted unit, or a part of a unit that was halved."""

    unit: Unit
    place: tuple[int, ...]  # which half (0 or 1), for each time that the unit was halved


class _Rendering:
    """The units of a job that are submitted to a cluster."""

    def __init__(self, cluster: Cluster, job: Job) -> None:
        self.cluster, self.client, self.job = cluster, cluster.client, job
        self.pending: dict[Future, _Task] = {}
        self.halves: dict[int, dict[tuple[int, ...], tuple[Tile, np.ndarray]]] = {}
        self.sent: Counter[tuple[str, Content]] = Counter()
        self.deaths: Counter[_Task] = Counter()
        self.messages: set[str] = set()

    def results(self, units: Iterator[Unit]) -> Results:
        """Submit units, and yield them when they are done."""
        units = iter(units)
        alive, ended = time.monotonic(), False
        try:
            while True:
                with _connected():
                    workers = self.cluster.worker_count
                if workers:
                    alive = time.monotonic()
                elif time.monotonic() - alive > 10:
                    self.tell_once("there is no worker; waiting for one")
                while not ended and len(self.pending) < UNITS_PER_WORKER * max(1, workers):
                    unit = next(units, None)
                    if unit is None:
                        ended = True
                    else:
                        self.submit(_Task(unit, ()))
                if not self.pending:
                    return
                done = self.completed()
                if not done:
                    yield None
                for future in done:
                    yield self.received(future)
        finally:
            with contextlib.suppress(Exception):
                self.client.cancel(list(self.pending), force=True)

    def completed(self) -> list[Future]:
        """Futures that have ended; an empty list if none ends within a second."""
        from distributed import wait

        with _connected():
            try:
                done = wait(list(self.pending), timeout=1, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                return []
        return sorted(done, key=lambda future: self.pending[future].unit.index)

    def submit(self, task: _Task) -> None:
        """Submit a task. Units that are merged first have the highest priority."""
        with _connected():
            future = self.client.submit(
                pickle.loads,
                packed(self.job, task.unit),
                key=f"unit-{task.unit.index}-{uuid.uuid4().hex}",
                priority=-task.unit.index,
                pure=False,
            )
        self.pending[future] = task

    def received(self, future: Future) -> tuple[Unit, Tile, np.ndarray] | None:
        """Handle the end of a task. Returns a unit that is done, or None if there is more to do."""
        if future.status in ("pending", "lost"):
            # The worker died before its result was fetched. Dask gives the task to another one.
            return None
        task = self.pending.pop(future)
        if future.status == "error":
            self.failed(task, future.exception())
            return None
        if future.status != "finished":
            raise ClusterError(GONE)
        with _connected():
            answer = future.result()
        if answer.missing:
            self.send(answer)
            self.submit(task)
            return None
        if answer.trimmed_too_far:
            self.tell_once("trimmed structures did not suffice: built in full")
        if not task.place:
            return task.unit, *answer.part
        return self.joined(task, answer)

    def failed(self, task: _Task, error: Exception) -> None:
        """Halve a unit that needs too much memory; raise for everything else."""
        from distributed.scheduler import KilledWorker

        if isinstance(error, ModuleNotFoundError):
            raise ClusterError(f"a worker lacks a package: {error}") from error
        if not isinstance(error, KilledWorker | MemoryError):
            raise error
        self.deaths[task] += 1
        if isinstance(error, KilledWorker) and not self.lacked_memory(error):
            if self.deaths[task] <= TRIALS:  # workers may be killed for any reason
                self.submit(task)
                return
        unit = task.unit
        halves = unit.halves() if len(task.place) < HALVINGS else None
        if halves is None:
            raise ClusterError(
                f"workers die of no more than {unit.spp * unit.tile.pixels} samples, most likely "
                "as the scene needs more memory than they have: give them more (--memory-limit), "
                "use fewer workers, or --trim"
            ) from error
        self.tell_once(
            "a unit was too much for a worker's memory: halved, so that the noise of the image is "
            "another, of the same size"
        )
        self.halves.setdefault(unit.index, {})
        for number, half in enumerate(halves):
            self.submit(_Task(half, (*task.place, number)))

    def lacked_memory(self, error: KilledWorker) -> bool:
        """Whether the worker that died last was ended because it used too much memory."""
        with _connected():
            events = self.client.get_events("worker-restart-memory")
        return any(event.get("worker") == error.last_worker.address for _, event in events)

    def joined(self, task: _Task, answer: Answer) -> tuple[Unit, Tile, np.ndarray] | None:
        """Add a half to its unit. Returns the unit if it is complete.

        Halves are summed in a fixed order, whichever arrives first.
        """
        found = self.halves[task.unit.index]
        found[task.place] = answer.part
        place = task.place
        while place:
            first, second = (found.get((*place[:-1], number)) for number in range(2))
            if first is None or second is None:
                return None
            for number in range(2):
                del found[(*place[:-1], number)]
            place = place[:-1]
            found[place] = _sum([first, second])
        tile, sums = self.halves.pop(task.unit.index)[()]
        return task.unit, tile, sums

    def send(self, answer: Answer) -> None:
        """Send a worker the files that it lacks.

        Raises:
            ClusterError: they do not arrive.
            OSError, ValueError: a file is gone, or has changed.
        """
        for content in answer.missing:
            if content not in self.job.package.contents:
                raise BadPackage(f"{answer.worker} asks for a file that the scene does not name")
            self.sent[answer.worker, content] += 1
            error = None
            for offset, piece, last in pieces(content):
                try:
                    self.client.run(receive, content, offset, piece, last, workers=[answer.worker])
                except Exception as failure:
                    # If the worker has died, it neither receives the file nor needs it.
                    error = failure
                    break
            if error is not None and self.sent[answer.worker, content] > 3:
                raise ClusterError(
                    f"{content.path} does not arrive at the worker {answer.worker}: {error}"
                ) from error

    def tell_once(self, message: str) -> None:
        """Tell the user a message, but only the first time."""
        if message not in self.messages:
            self.messages.add(message)
            self.cluster._tell(message)


@contextlib.contextmanager
def _connected() -> Iterator[None]:
    """A context that raises :class:`ClusterError` if the connection to the scheduler is lost."""
    from distributed import CancelledError
    from distributed.comm import CommClosedError

    try:
        yield
    except (OSError, CommClosedError, CancelledError) as error:
        raise ClusterError(GONE) from error


def _sum(parts: list[tuple[Tile, np.ndarray]]) -> tuple[Tile, np.ndarray]:
    """The sum of two tiles, over the smallest rectangle that contains both."""
    (first, a), (second, b) = parts
    x, y = min(first.x, second.x), min(first.y, second.y)
    right = max(tile.x + tile.width for tile in (first, second))
    bottom = max(tile.y + tile.height for tile in (first, second))
    both = Tile(x, y, right - x, bottom - y)
    sums = np.zeros((both.height, both.width, a.shape[-1]), np.float32)
    for tile, part in ((first, a), (second, b)):
        sums[tile.slices(both)] += part
    return both, sums


def _is_loopback(address: str) -> bool:
    host = address.rpartition(":")[0].strip("[]") or address
    return host in ("localhost", "::1") or host.startswith("127.")


def core_count() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def visible_gpus() -> list[str]:
    """Names, for ``CUDA_VISIBLE_DEVICES``, of the NVIDIA GPUs that this process may use."""
    import ctypes

    try:
        driver = ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return []
    count = ctypes.c_int(0)
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)):
        return []
    named = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    names = [name.strip() for name in named if name.strip()]
    return (names or [str(number) for number in range(count.value)])[: count.value]
