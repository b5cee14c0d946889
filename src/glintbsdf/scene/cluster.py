"""Units rendered by many processes, on this machine or on many, through Dask.

A worker is sent a unit and the description of its image. It checks that its versions are the same,
says which files of the scene it lacks, loads the scene once, and returns the sums of the unit. The
client holds no more units than workers can be busy with, so neither it nor the scheduler grows with
the number of units. Dask gives the units of a worker that has died to others; which worker made
what does not show in the image.

Workers run whatever their scheduler sends: who can reach it can do what the workers can. A local
cluster listens on loopback only; across machines use TLS.
"""

from __future__ import annotations

import atexit
import contextlib
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

#: Seconds until a scheduler must have answered.
PATIENCE = 8.0

#: Units under way for each worker: one that it renders, and one that it will.
AHEAD = 2

#: Scenes that a worker keeps loaded: frames of a sequence follow each other.
SCENES = 2

#: Environment variable of a worker: threads that it renders with, where they are not Dask's.
THREADS = "GLINTBSDF_THREADS"

#: How often a unit that needs too much memory is halved.
HALVINGS = 2

#: How often a unit that workers have died of is given out again, where Dask does not know that they
#: lacked memory. Dask itself does so once or more each time.
TRIALS = 2


GONE = "the scheduler is gone; with --checkpoint the same command goes on from what is done"


class ClusterError(RuntimeError):
    """Something is the matter with the scheduler or its workers; the message says what."""


# ------------------------------------------------------------------------------------------------
#  On a worker
# ------------------------------------------------------------------------------------------------

_lock = threading.RLock()  # Mitsuba's variant and Dr.Jit's threads are those of the process
_loaded: OrderedDict[Job, tuple[Renderer, ExitStack]] = OrderedDict()


@atexit.register
def _forget() -> None:
    """Let go of what is loaded, as long as there is a Mitsuba to do it."""
    while _loaded:
        _, (_, stack) = _loaded.popitem()
        stack.close()


@dataclass(frozen=True)
class Answer:
    """What a worker returns for a unit.

    Attributes:
        worker (str): its address.
        missing (tuple[Content, ...]): files that it must be sent first.
        tile, sums: what :func:`.sums_of_samples` returns for the unit, where nothing was missing.
        trimmed_too_far (bool): structures had to be built in full.
    """

    worker: str
    missing: tuple[Content, ...] = ()
    tile: Tile | None = None
    sums: np.ndarray | None = None
    trimmed_too_far: bool = False

    @property
    def part(self) -> tuple[Tile, np.ndarray]:
        """Tile and sums of a unit of which nothing was missing."""
        if self.tile is None or self.sums is None:
            raise ValueError("the worker has not rendered the unit: files were missing")
        return self.tile, self.sums


class _Call:
    """An object that calls a function where it is unpickled."""

    def __init__(self, function: Callable, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable, tuple]:
        return self.call


def packed(job: Job, unit: Unit) -> bytes:
    """A task for Dask: unpickling it runs :func:`work`.

    A worker without this package, or with another version, can receive it and fail with a sentence.
    A task that it cannot read would end it, again and again.
    """
    return pickle.dumps(_Call(work, versions(), pickle.dumps((job, unit))))


def work(expected: dict[str, str], task: bytes) -> Answer:
    """Render a unit, on a worker.

    Args:
        expected: versions that the worker must have.
        task: the pickled job and unit.

    Raises:
        ClusterError: the worker has other versions, or lacks what the variant needs.
        MemoryError: the worker has not enough memory.
    """
    from distributed import get_worker

    worker = get_worker()
    difference = version_difference(expected)
    if difference is not None:
        raise ClusterError(f"the worker {worker.address} has {difference}")
    job, unit = pickle.loads(task)
    with _lock:
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
    """Whether the structures of a renderer, if they are trimmed, have been enough so far."""
    trimmed = getattr(renderer.missed, "__self__", None)
    return not isinstance(trimmed, Trimmed) or trimmed.sufficed


def _renderer(job: Job, store: Store, threads: int) -> Renderer:
    """The scene of a job, loaded at its first unit."""
    if job in _loaded:
        _loaded.move_to_end(job)
        return _loaded[job][0]
    if job.variant not in mi.variants():
        raise ClusterError(f"a worker's Mitsuba has no variant {job.variant}")
    if mi.variant() != job.variant:
        _forget()
    while len(_loaded) >= SCENES:
        _, (_, stack) = _loaded.popitem(last=False)
        stack.close()
    if job.variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise ClusterError(f"{job.variant} needs an NVIDIA GPU, and a worker has none")
    if mi.variant() != job.variant:
        mi.set_variant(job.variant)
    with _spare_thread(threads):
        scene = job.package.load(store, deferred=job.trim)
        missed = (
            Trimmed(Inspected.of(scene), job.spp, job.sensor).missed if job.trim else lambda: False
        )
    with ExitStack() as stack:
        renderer = stack.enter_context(Renderer(scene, job.spp, job.denoise, missed, job.sensor))
        _loaded[job] = renderer, stack.pop_all()
    return renderer


@contextlib.contextmanager
def _spare_thread(threads: int) -> Iterator[None]:
    """Give Dr.Jit two threads at least in the block, which Mitsuba needs to read OpenEXR files;
    after the block, as many as are given."""
    dr.set_thread_count(max(2, threads))
    try:
        yield
    finally:
        dr.set_thread_count(threads)


def dask_setup(worker: object) -> None:
    """Called by Dask in each process of a local cluster: a terminal sends Ctrl-C to all processes,
    and the one that knows what is done decides."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def receive(content: Content, offset: int, piece: bytes, last: bool, dask_worker=None) -> None:
    """Take a piece of a file, on a worker. See :meth:`.Store.receive`."""
    Store(Path(dask_worker.local_directory) / "glintbsdf-files").receive(
        content, offset, piece, last
    )


# ------------------------------------------------------------------------------------------------
#  At the client
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Keys:
    """Files for TLS, as Dask names them: certificates of the authority and of this client, and its
    private key."""

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
        """Processes on this machine that share its cores, reachable from this machine only.

        Args:
            workers: number of processes.
            memory_limit: memory that each process may take, such as ``4GB``; a process beyond it
                is ended. ``auto``: its part of the machine's memory.
            variant: variant of Mitsuba; on GPUs each worker gets one GPU.
            tell: is called with what happens meanwhile, in words.
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
        """The workers of a scheduler that runs already.

        Args:
            address: such as ``tcp://host:8786``, or ``tls://host:8786``; the scheme may be left
                out.
            keys: files for TLS.
            tell: is called with what happens meanwhile, in words.

        Raises:
            ClusterError: on entering, if no scheduler answers, or its workers have another version.
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
                Client(f"{scheme}://{rest}", timeout=PATIENCE, security=security)
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
        """Raise unless all workers that are there have this package, in these versions."""
        import importlib.metadata

        # Without this package a worker could not even read a question that is part of it.
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
        """Workers that are there now."""
        return len(self.client.nthreads())

    def __str__(self) -> str:
        count = self.worker_count
        return f"{count} worker" + ("s" if count != 1 else "")

    def render_all(self, job: Job) -> Callable[[Iterator[Unit]], Results]:
        """What renders the units of a job, for :func:`~glintbsdf.scene.rendering.produce`.

        Raises:
            ClusterError: raised by its iterator, if the scheduler is gone, a worker has another
                version, or no worker has the memory that a unit needs.
        """
        return lambda units: _Rendering(self, job).results(units)


#: Settings of Dask for a local cluster: memory is for rendering, not for keeping results, and a
#: worker whose kernels take long is not dead.
_LOCAL_SETTINGS = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.scheduler.allowed-failures": 1,
    # A unit that waits at a worker is not suspected of its death.
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.scheduler.worker-ttl": None,
    "distributed.admin.tick.limit": "1h",
}


@dataclass(frozen=True)
class _Errand:
    """A unit that is under way, or a part of one that was halved."""

    unit: Unit
    place: tuple[int, ...]  # 0 or 1 for each time that it was halved


class _Rendering:
    """Units of a job under way on a cluster."""

    def __init__(self, cluster: Cluster, job: Job) -> None:
        self.cluster, self.client, self.job = cluster, cluster.client, job
        self.flying: dict[Future, _Errand] = {}
        self.halves: dict[int, dict[tuple[int, ...], tuple[Tile, np.ndarray]]] = {}
        self.sent: Counter[tuple[str, Content]] = Counter()
        self.deaths: Counter[_Errand] = Counter()
        self.told: set[str] = set()

    def results(self, units: Iterator[Unit]) -> Results:
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
                while not ended and len(self.flying) < AHEAD * max(1, workers):
                    unit = next(units, None)
                    if unit is None:
                        ended = True
                    else:
                        self.submit(_Errand(unit, ()))
                if not self.flying:
                    return
                done = self.landed()
                if not done:
                    yield None
                for future in done:
                    yield self.received(future)
        finally:
            with contextlib.suppress(Exception):
                self.client.cancel(list(self.flying), force=True)

    def landed(self) -> list[Future]:
        """Futures that have come to an end; none where a second passes without any."""
        from distributed import wait

        with _connected():
            try:
                done = wait(list(self.flying), timeout=1, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                return []
        return sorted(done, key=lambda future: self.flying[future].unit.index)

    def submit(self, errand: _Errand) -> None:
        # The first units are the first to be merged.
        with _connected():
            future = self.client.submit(
                pickle.loads,
                packed(self.job, errand.unit),
                key=f"unit-{errand.unit.index}-{uuid.uuid4().hex}",
                priority=-errand.unit.index,
                pure=False,
            )
        self.flying[future] = errand

    def received(self, future: Future) -> tuple[Unit, Tile, np.ndarray] | None:
        """What has become of an errand: a unit that is done, or None if there is more to do."""
        errand = self.flying.pop(future)
        if future.status == "error":
            self.failed(errand, future.exception())
            return None
        if future.status != "finished":
            raise ClusterError(GONE)
        with _connected():
            answer = future.result()
        if answer.missing:
            self.send(answer)
            self.submit(errand)
            return None
        if answer.trimmed_too_far:
            self.tell_once("trimmed structures did not suffice: built in full")
        if not errand.place:
            return errand.unit, *answer.part
        return self.joined(errand, answer)

    def failed(self, errand: _Errand, error: Exception) -> None:
        """Halve a unit that needs too much memory; raise for everything else."""
        from distributed.scheduler import KilledWorker

        if isinstance(error, ModuleNotFoundError):
            raise ClusterError(f"a worker lacks a package: {error}") from error
        if not isinstance(error, KilledWorker | MemoryError):
            raise error
        self.deaths[errand] += 1
        if isinstance(error, KilledWorker) and not self.lacked_memory(error):
            if self.deaths[errand] <= TRIALS:  # as workers may be killed for any reason
                self.submit(errand)
                return
        unit = errand.unit
        halves = unit.halves() if len(errand.place) < HALVINGS else None
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
            self.submit(_Errand(half, (*errand.place, number)))

    def lacked_memory(self, error: KilledWorker) -> bool:
        """Whether the worker that has died last was ended for its use of memory."""
        with _connected():
            events = self.client.get_events("worker-restart-memory")
        return any(event.get("worker") == error.last_worker.address for _, event in events)

    def joined(self, errand: _Errand, answer: Answer) -> tuple[Unit, Tile, np.ndarray] | None:
        """Add a half to its unit; the unit, if it is whole then.

        Halves are added in their own order, whichever came first.
        """
        found = self.halves[errand.unit.index]
        found[errand.place] = answer.part
        place = errand.place
        while place:
            first, second = (found.get((*place[:-1], number)) for number in range(2))
            if first is None or second is None:
                return None
            for number in range(2):
                del found[(*place[:-1], number)]
            place = place[:-1]
            found[place] = _sum([first, second])
        tile, sums = self.halves.pop(errand.unit.index)[()]
        return errand.unit, tile, sums

    def send(self, answer: Answer) -> None:
        """Send a worker the files that it lacks.

        Raises:
            ClusterError: they do not arrive.
            OSError, ValueError: a file is gone, or has been changed.
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
                    # A worker that has died meanwhile is not there to receive it, or to miss it.
                    error = failure
                    break
            if error is not None and self.sent[answer.worker, content] > 3:
                raise ClusterError(
                    f"{content.path} does not arrive at the worker {answer.worker}: {error}"
                ) from error

    def tell_once(self, message: str) -> None:
        if message not in self.told:
            self.told.add(message)
            self.cluster._tell(message)


@contextlib.contextmanager
def _connected() -> Iterator[None]:
    """Raise ClusterError if the connection to the scheduler is lost in the block."""
    from distributed import CancelledError
    from distributed.comm import CommClosedError

    try:
        yield
    except (OSError, CommClosedError, CancelledError) as error:
        raise ClusterError(GONE) from error


def _sum(parts: list[tuple[Tile, np.ndarray]]) -> tuple[Tile, np.ndarray]:
    """Sums of two tiles, over the smallest rectangle that holds both."""
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
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def visible_gpus() -> list[str]:
    """NVIDIA GPUs that this process may use, by the names of ``CUDA_VISIBLE_DEVICES``."""
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
