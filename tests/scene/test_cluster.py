"""Rendering by many processes: the image is the same to the last bit, whatever happens to them."""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.scene import cluster as clusters
from glintbsdf.scene import package, rendering, units
from glintbsdf.scene.cluster import Cluster, ClusterError, Keys
from glintbsdf.scene.package import Job, Package
from glintbsdf.scene.passes import Tile
from glintbsdf.scene.storage import Checkpoint
from tests.small_scenes import ball, square, write_heights

pytest.importorskip("distributed")
# Dask leaves sockets and loops to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore")

SPP = 48  # in units of 2 samples per pixel
SCENE = square(ball(1, 1, 0, radius=0.4), origin="0,1,4", rfilter="gaussian", spp=SPP, depth=4,
               plugin="glint_filtered")  # fmt: skip
UNITS = 24


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str) -> Path:
    """The current folder, with a small scene and its map in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(units, "FEWEST", 512)
    (tmp_path / "scene.xml").write_text(SCENE)
    write_heights(tmp_path / "map.exr")
    return tmp_path


@pytest.fixture
def job(folder: Path, variant: str) -> Job:
    return Job(Package.of("scene.xml"), variant, SPP, 7)


@pytest.fixture(scope="module")
def two() -> Cluster:
    """Two processes, for all tests that do not end them."""
    with Cluster.local(2, tell=print) as cluster:
        yield cluster


def image(job: Job, cluster: Cluster | None, render_all=None, **options) -> np.ndarray:
    scene = rendering.load_scene("scene.xml", dict(job.package.definitions))
    with rendering.Renderer(scene, job.spp, job.denoise) as renderer:
        assert len(renderer.plan(job.seed)) == UNITS
        render_all = render_all or (cluster and cluster.render_all(job))
        return np.array(rendering.produce(renderer, job.seed, render_all, **options).bitmap)


_ALONE: dict[str, np.ndarray] = {}


def alone(job: Job, **options) -> np.ndarray:
    """The image of this process alone; many tests want the same."""
    key = repr((job.description(), options))
    if key not in _ALONE:
        _ALONE[key] = image(job, None, **options)
    return _ALONE[key]


def pids(cluster: Cluster) -> list[int]:
    return list(cluster.client.run(os.getpid, on_error="ignore").values())


# ---------------------------------------------------------------------------------------------
#  The same image
# ---------------------------------------------------------------------------------------------


def test_two_processes(job, two):
    assert np.array_equal(image(job, two), alone(job))
    # Threads are divided: Dask gives each worker one unit at a time, for all of its threads.
    threads = two.client.run(os.getenv, clusters.THREADS)
    assert set(threads.values()) == {str(max(1, clusters.core_count() // 2))}
    assert set(two.client.nthreads().values()) == {1}


@pytest.mark.parametrize("changes", [{"trim": True}, {"denoise": True}], ids=["trim", "denoise"])
def test_options(job, two, changes, folder):
    if "denoise" in changes:
        pytest.importorskip("mitsuba_oidn")
    package = Package.of("scene.xml", {"integrator": "glint_path"})
    job = replace(job, package=package, **changes)
    assert np.array_equal(image(job, two), alone(job))


@pytest.mark.parametrize("colours", ["spectral", "spectral_polarized"])
def test_other_variants(job, two, variant, colours):
    """A worker changes its variant, too."""
    backend = variant.split("_")[0]
    mi.set_variant(f"{backend}_ad_{colours}")
    job = replace(job, variant=mi.variant())
    assert np.array_equal(image(job, two), alone(job))


def test_a_killed_worker(job):
    """SIGKILL during rendering: other workers get its units, and it is replaced."""
    with Cluster.local(3) as cluster:
        before = set(pids(cluster))
        merged = []

        def kill(done) -> None:
            merged.append(done.count)
            if len(merged) in (2, 5):
                os.kill(pids(cluster)[0], signal.SIGKILL)

        killed = image(job, cluster, observe=kill)
        assert before - set(pids(cluster))
    assert np.array_equal(killed, alone(job))


def test_workers_of_unequal_speed(job):
    with Cluster.local(3) as cluster:
        slow = pids(cluster)[0]
        os.kill(slow, signal.SIGSTOP)
        try:
            render_all = cluster.render_all(job)

            def watched(wanted):
                for number, result in enumerate(render_all(wanted)):
                    if number == 8:
                        os.kill(slow, signal.SIGCONT)
                    yield result

            unequal = image(job, cluster, watched)
        finally:
            os.kill(slow, signal.SIGCONT)
    assert np.array_equal(unequal, alone(job))


def test_files_are_sent_where_they_are_not(job, two):
    """As if to another machine, where no path of the sender exists."""

    def away(group):
        return tuple((name, replace(content, path="/nowhere")) for name, content in group)

    sent = []
    original = package.pieces
    there = {content.digest: content for content in job.package.contents}
    travelling = replace(job.package, documents=away(job.package.documents),
                         files=away(job.package.files))  # fmt: skip

    def of_the_sender(content):
        sent.append(content.digest)
        return original(there[content.digest])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clusters, "pieces", of_the_sender)
        remote = image(replace(job, package=travelling), two)
    assert set(sent) == set(there)
    assert np.array_equal(remote, alone(job))


# ---------------------------------------------------------------------------------------------
#  Interruption and continuation
# ---------------------------------------------------------------------------------------------


def test_a_checkpoint_serves_any_number_of_processes(job, two, tmp_path):
    class Enough(Exception):
        pass

    def end(done) -> None:
        if done.count >= 9:
            raise Enough

    with pytest.raises(Enough):
        image(job, two, checkpoint=Checkpoint(tmp_path / "kept", job.description()), observe=end)
    rendered = []
    original = rendering.Renderer.render
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            rendering.Renderer,
            "render",
            lambda self, unit: (rendered.append(unit.index), original(self, unit))[1],
        )
        resumed = image(job, None, checkpoint=Checkpoint(tmp_path / "kept", job.description()))
    assert 0 < len(rendered) <= UNITS - 9
    assert np.array_equal(resumed, alone(job))


def test_until_noise(job, two):
    noisy = image(job, two, until_noise=1e-9)
    assert np.array_equal(noisy, alone(job))
    limit = 0.05
    assert np.array_equal(image(job, two, until_noise=limit), alone(job, until_noise=limit))


# ---------------------------------------------------------------------------------------------
#  Memory
# ---------------------------------------------------------------------------------------------


def no_more_than(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make workers lack memory for units of more than ``most`` samples."""
    original = clusters.packed

    def packed(job: Job, unit: units.Unit) -> bytes:
        if unit.spp * unit.tile.pixels > most:
            return pickle.dumps(clusters._Call(bytes, 1 << 62))  # more than there can be
        return original(job, unit)

    monkeypatch.setattr(clusters, "packed", packed)


def test_a_unit_that_is_too_large_is_halved(job, two, capsys, monkeypatch):
    """It is halved once, and the image has different noise, but the same light."""
    no_more_than(256, monkeypatch)
    halved = image(job, two)
    assert "halved, so that the noise of the image is another" in capsys.readouterr().out
    assert np.array_equal(halved, image(job, two))
    expected = alone(job)
    assert not np.array_equal(halved, expected)
    assert halved.mean() == pytest.approx(expected.mean(), rel=0.05)


def test_a_scene_that_is_too_large_is_reported(job, two, monkeypatch):
    no_more_than(0, monkeypatch)
    with pytest.raises(ClusterError, match="needs more memory than they have"):
        image(job, two)


def test_sums_of_halves():
    """Tiles of halves may overlap by the filter's reach, or be equal."""
    first, second = Tile(2, 3, 4, 2), Tile(2, 4, 4, 3)
    both, sums = clusters._sum(
        [(first, np.full((2, 4, 1), 1.0)), (second, np.full((3, 4, 1), 2.0))]
    )
    assert both == Tile(2, 3, 4, 4)
    assert sums[:, 0, 0].tolist() == [1, 3, 2, 2]


# ---------------------------------------------------------------------------------------------
#  Errors
# ---------------------------------------------------------------------------------------------


def test_another_version(job, two, monkeypatch):
    older = {**package.versions(), "glintbsdf": "0.0.1"}
    monkeypatch.setattr(clusters, "versions", lambda: older)
    with pytest.raises(ClusterError, match=r"the worker tcp://\S+ has glintbsdf 0\.1.*not 0\.0\.1"):
        two._check_versions()
    with pytest.raises(ClusterError, match=r"has glintbsdf 0\.1"):
        image(job, two)


def test_an_error_of_the_scene_is_passed_on(job, two):
    bad = replace(job, package=replace(job.package, definitions=(("nothing", "1"),)))
    with pytest.raises(RuntimeError, match="nothing=1"):
        image(job, None, two.render_all(bad))


def closed_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.parametrize("host", ["127.0.0.1", "no-such-host.invalid"])
def test_no_such_scheduler(host, monkeypatch):
    monkeypatch.setattr(clusters, "TIMEOUT", 1.0)
    begun = time.monotonic()
    with pytest.raises(ClusterError, match="no scheduler answers"):
        Cluster.at(f"{host}:{closed_port()}", tell=print).__enter__()
    assert time.monotonic() - begun < 3


def test_addresses():
    keys = Keys(Path("ca"), Path("cert"), Path("key"))
    for address, given in (("http://a:1", None), ("tls://a:1", None), ("tcp://a:1", keys)):
        with pytest.raises(ClusterError):
            Cluster.at(address, given)


@pytest.mark.parametrize("address, warned", [("127.0.0.1", False), ("192.0.2.1", True)])
def test_a_warning_without_tls(address, warned, monkeypatch):
    monkeypatch.setattr(clusters, "TIMEOUT", 0.2)
    told = []
    with pytest.raises(ClusterError):
        Cluster.at(f"{address}:{closed_port()}", tell=told.append).__enter__()
    assert bool(told) == warned and all("without TLS" in message for message in told)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_local_cluster_listens_on_loopback_only(two):
    """This holds for scheduler, nannies, workers, and their dashboards."""
    owners = {os.getpid(), *pids(two), *two.client.run(os.getppid).values()}
    children = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(os.getpid())], capture_output=True, text=True
    )
    owners |= {int(pid) for pid in children.stdout.split()}
    inodes = set()
    for pid in owners:
        for link in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                inodes.add(os.readlink(link))
            except OSError:
                continue
    listening = []
    for table, loopback in (("tcp", "0100007F"), ("tcp6", "0" * 24 + "01000000")):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and f"socket:[{fields[9]}]" in inodes:
                listening.append(fields[1].partition(":")[0] == loopback)
    assert len(listening) >= 4 and all(listening)


# ---------------------------------------------------------------------------------------------
#  A separate scheduler
# ---------------------------------------------------------------------------------------------


def listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
        return True
    return False


class Scheduler:
    """``dask scheduler`` and a ``dask worker``, as a user starts them."""

    def __init__(
        self,
        folder: Path,
        *options: str,
        scheme: str = "tcp",
        worker_path: Path | None = None,
        scheduler_path: Path | None = None,
    ) -> None:
        self.address = f"{scheme}://127.0.0.1:{closed_port()}"
        port = self.address.rpartition(":")[2]
        common = ["--host", "127.0.0.1", *options]
        self.processes = [
            self.start(
                folder, scheduler_path, "scheduler", "--port", port, "--no-dashboard", *common
            ),
            self.start(folder, worker_path, "worker", self.address, "--no-dashboard", *common),
        ]
        # Users wait for the scheduler's address before they pass it to a command.
        while not listens(int(port)):
            assert self.processes[0].poll() is None
            time.sleep(0.2)

    @staticmethod
    def start(folder: Path, path: Path | None, *arguments: str) -> subprocess.Popen:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments],
            cwd=folder,
            env=os.environ if path is None else {**os.environ, "PYTHONPATH": str(path)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def kill(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


def test_a_killed_scheduler(job, folder, tmp_path):
    """The command ends with an error, and continues from its checkpoint with another scheduler."""

    def kept() -> Checkpoint:
        return Checkpoint(tmp_path / "kept", job.description())

    scheduler = Scheduler(tmp_path)
    try:
        with Cluster.at(scheduler.address, tell=print) as cluster:

            def kill(done) -> None:
                if done.count >= 5:
                    scheduler.kill()

            with pytest.raises(ClusterError, match="the scheduler is gone"):
                image(job, cluster, observe=kill, checkpoint=kept())
    finally:
        scheduler.kill()
    scheduler = Scheduler(tmp_path)
    try:
        with Cluster.at(scheduler.address, tell=print) as cluster:
            counts = []
            resumed = image(
                job, cluster, observe=lambda done: counts.append(done.count), checkpoint=kept()
            )
    finally:
        scheduler.kill()
    assert counts[0] >= 5
    assert np.array_equal(resumed, alone(job))


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    """A folder for PYTHONPATH with which a Python has no glintbsdf."""
    path = tmp_path / "without"
    path.mkdir()
    (path / "sitecustomize.py").write_text(
        "import sys, importlib.metadata as metadata\n"
        "class Without:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] == 'glintbsdf':\n"
        "            raise ModuleNotFoundError(f\"No module named '{name}'\", name=name)\n"
        "sys.meta_path.insert(0, Without())\n"
        "version = metadata.version\n"
        "def without(name):\n"
        "    if name == 'glintbsdf':\n"
        "        raise metadata.PackageNotFoundError(name)\n"
        "    return version(name)\n"
        "metadata.version = without\n"
    )
    return path


def worker_there(scheduler: Scheduler) -> None:
    """Wait until a scheduler has its worker."""
    from distributed import Client

    with Client(scheduler.address, timeout=60) as client:
        client.wait_for_workers(1, timeout=60)


def test_a_worker_without_the_package(job, tmp_path, elsewhere):
    scheduler = Scheduler(tmp_path, worker_path=elsewhere)
    try:
        worker_there(scheduler)
        with pytest.raises(ClusterError, match=r"the worker tcp://\S+ has no glintbsdf"):
            Cluster.at(scheduler.address, tell=print).__enter__()
        late = Cluster(None, print)  # an answer that arrives when nobody waits for it
        from distributed import Client

        with Client(scheduler.address) as late.client:
            with pytest.raises(ClusterError, match="a worker lacks a package: .*glintbsdf"):
                image(job, late)
    finally:
        scheduler.kill()


def test_a_scheduler_without_the_package(job, tmp_path, elsewhere):
    """The scheduler does not need the package."""
    scheduler = Scheduler(tmp_path, scheduler_path=elsewhere)
    try:
        with Cluster.at(scheduler.address, tell=print) as cluster:
            assert np.array_equal(image(job, cluster), alone(job))
    finally:
        scheduler.kill()


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    """A certificate from a private authority, for scheduler, worker and client."""
    if shutil.which("openssl") is None:
        pytest.skip("there is no openssl to make certificates")

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=tmp_path, check=True, capture_output=True)

    new = ("-newkey", "rsa:2048", "-nodes", "-days", "2")
    openssl("req", "-x509", *new, "-subj", "/CN=ca", "-keyout", "ca.key", "-out", "ca.pem")
    openssl("req", *new[:-2], "-subj", "/CN=node", "-keyout", "node.key", "-out", "node.csr")
    openssl("x509", "-req", "-in", "node.csr", "-CA", "ca.pem", "-CAkey", "ca.key",
            "-CAcreateserial", "-days", "2", "-out", "node.pem")  # fmt: skip
    return Keys(*(tmp_path / name for name in ("ca.pem", "node.pem", "node.key")))


def test_tls(job, keys, tmp_path):
    """The image is the same; a client without a key, or with one of another authority, gets no
    answer."""
    files = ("--tls-ca-file", keys.ca_file, "--tls-cert", keys.cert, "--tls-key", keys.key)
    scheduler = Scheduler(tmp_path, *map(str, files), "--protocol", "tls", scheme="tls")
    try:
        with Cluster.at(scheduler.address, keys, tell=print) as cluster:
            assert np.array_equal(image(job, cluster), alone(job))
        begun = time.monotonic()
        with pytest.raises(ClusterError, match="no scheduler answers"):
            Cluster.at(scheduler.address.replace("tls", "tcp"), tell=print).__enter__()
        assert time.monotonic() - begun < 10
        stranger = tmp_path / "stranger.pem"
        subprocess.run(
            ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=x",
             "-keyout", "/dev/null", "-out", str(stranger)], check=True, capture_output=True,
        )  # fmt: skip
        with pytest.raises(ClusterError, match="no scheduler answers"):
            Cluster.at(scheduler.address, replace(keys, ca_file=stranger), tell=print).__enter__()
    finally:
        scheduler.kill()
