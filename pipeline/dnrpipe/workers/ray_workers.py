"""Workers on a Ray cluster: each an actor, in a process of its own on some node. The only module that imports ray.

A crash of bpy or Mitsuba ends the actor, not the node. Ray itself restarts and repeats nothing (``max_restarts`` and
``max_task_retries`` are 0; after an out-of-memory kill it would repeat a plain task without end): the loop of
`task_list` does, as it does with local processes.
"""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import signal
import socket
import sys
import tempfile
import threading
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dnrtrain.text import one_line

from .. import __version__
from ..core.errors import UserError
from ..core.machine import cache_root
from ..core.settings import ExecutorSettings
from .placement import Placement, WorkerLost
from .processes import Answerer, WorkerDied
from .shipping import Mirror, Pack, moved, packed, packs_of, receive, under

PACKAGES = ("ray", "numpy", "bpy", "mitsuba", "drjit", "torch", "OpenEXR")
"""Versions that have to agree: pictures and weights follow from them."""
BEFORE_IMPORT = {
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # else `uv run` ships the working directory
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".*",  # else what Ray says of a dead worker lands on standard output, amid our JSON
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # actors without a GPU are told so by us
}
"""Ray reads these when it is imported."""
READY_POLL = 0.1
MOST_FAILURES = 3
"""So often an actor may fail to start, one after the other."""
CLOSE_WAIT = 10.0
STATE_WAIT = 60.0
"""Seconds to wait for word of a node; Ray itself takes up to half a minute to notice that one is gone."""
LOG_TAIL = 1 << 16
"""Bytes of a worker's output that come back with an answer, at most."""
GPU_VARIANT = "cuda"


def ray_workers(
    module: str,
    common: dict[str, Any],
    log: Path,
    environment: dict[str, str],
    place: Placement,
    side_by_side: int,
    tasks: int,
) -> list[RayWorker]:
    """As many as the cluster has room for, and no more than tasks.

    Args:
        side_by_side: how many would share this machine; each gets that share of a machine's cores.

    Raises UserError: ray is not installed, there is no such cluster, or its packages are others.
    """
    connect(place.executor)
    import ray

    cores = os.cpu_count() or 1
    device = str(common.get("device", ""))
    on_gpu = GPU_VARIANT in str(common.get("variant", "")) or GPU_VARIANT in device
    if device == "auto":
        on_gpu = any(node["Resources"].get("GPU", 0) for node in ray.nodes() if node["Alive"])
    resources: dict[str, float] = {
        "num_cpus": max(1, cores // max(1, side_by_side)),
        "num_gpus": 1 if on_gpu else 0,
        "memory": int((place.memory_mb or 0) * 2**20),
    }
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    for name, kind in (("num_cpus", "CPU"), ("memory", "memory")):  # no more than some node has
        resources[name] = min(resources[name], int(max((node.get(kind, 0) for node in nodes), default=0)))
    resources["num_cpus"] = max(1, resources["num_cpus"])
    room = sum(
        int(min(node.get("CPU", 0) // resources["num_cpus"], node.get("GPU", 0) if on_gpu else float("inf")))
        for node in nodes
    )
    room = place.executor.workers or room  # more than fit make an autoscaler add nodes
    if room < 1:
        raise UserError(
            f"executor.address={place.executor.address}: no node has {resources['num_cpus']} processors"
            f"{' and a GPU' if on_gpu else ''}; where nodes are added on demand, say how many workers to ask for"
            " (executor.workers)"
        )
    return [RayWorker(module, common, log, environment, place, resources) for _ in range(max(1, min(room, tasks)))]


def connect(executor: ExecutorSettings) -> None:
    """Join the cluster that the settings name, once per process.

    Raises UserError: see `ray_workers`.
    """
    for name, value in BEFORE_IMPORT.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError:
        raise UserError("executor.engine=ray: Ray is not installed; type pip install 'dnrpipe[ray]'") from None
    if ray.is_initialized():
        return
    quiet: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    before = signal.getsignal(signal.SIGTERM)
    try:
        if executor.address == "local":
            ray.init(address="local", include_dashboard=False, **quiet)
        else:
            ray.init(address=executor.address, **quiet)
    except (ray.exceptions.RayError, ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        reason = one_line(error)
        raise UserError(f"executor.address={executor.address}: cannot join this Ray cluster ({reason})") from None
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)  # Ray takes it for itself
    logging.getLogger("ray").setLevel(logging.CRITICAL)  # a dead actor is told once, by us
    try:
        refuse_other_versions(executor)
    except (ray.exceptions.RayError, TimeoutError) as error:
        reason = one_line(error)[-300:]
        raise UserError(f"executor.address={executor.address}: a node does not run dnrpipe ({reason})") from None


def address_of(executor: ExecutorSettings) -> str:
    """HOST:PORT of the cluster that the settings name, for other processes to join; with ``local`` it lives as long as
    this one. Raises UserError: see `ray_workers`."""
    connect(executor)
    import ray

    return ray.get_runtime_context().gcs_address


def refuse_other_versions(executor: ExecutorSettings) -> None:
    """Raises UserError: a node has other packages than this machine, which would give other pictures."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    ask = ray.remote(num_cpus=0, max_retries=0)(installed)
    for node in [node for node in ray.nodes() if node["Alive"]]:
        strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        there: Any = ray.get(ask.options(scheduling_strategy=strategy).remote(), timeout=STATE_WAIT)
        if other := differences(there):
            name = node["NodeManagerHostname"]
            raise UserError(f"executor.address={executor.address}: node {name} has {other}; install the same there")


def differences(there: dict[str, str]) -> str:
    """What a node has that this machine has not, in words; "" where they agree."""
    here = installed()
    names = [name for name in here | there if here.get(name) != there.get(name)]
    return ", ".join(f"{name} {there.get(name, 'missing')} (here {here.get(name, 'missing')})" for name in names)


def installed() -> dict[str, str]:
    """What has to be the same on all nodes."""
    found = {"python": platform.python_version(), "dnrpipe": __version__}
    for name in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    weights = cache_root() / "weights" / "weights.json"
    return found | {"perceptual weights": "there" if weights.is_file() else "missing"}


class RayWorker:
    """An actor that is asked task by task, started when there is room for it. Args: of `ray_workers`."""

    def __init__(
        self,
        module: str,
        common: dict[str, Any],
        log: Path,
        environment: dict[str, str],
        place: Placement,
        resources: dict[str, float],
    ) -> None:
        self.module, self.common, self.log, self.place = module, common, log, place
        threads = str(int(resources["num_cpus"]))
        # Ray sets OMP_NUM_THREADS to the actor's processors where nobody did; our workers were told by the stage.
        self.environment = {"OMP_NUM_THREADS": threads, "PYTHONUNBUFFERED": "1", **environment}
        if not resources["num_gpus"]:
            self.environment["CUDA_VISIBLE_DEVICES"] = ""
        self.resources = resources
        self._actor: Any = None
        self._started: Any = None
        self._node = ""
        self._refused = ""
        self._failures = 0
        self._closed = False

    def ready(self) -> bool:
        """Whether the actor runs; it is asked for where there is none."""
        import ray

        if self._actor is None:
            kind = ray.remote(max_restarts=0, max_task_retries=0)(RemoteWorker)
            roots = [str(root) for root in self.place.roots]
            options = {**self.resources, "runtime_env": {"env_vars": self.environment}}
            self._actor = kind.options(**options).remote(self.module, self.common, roots, self.place.executor.shared)
            self._started = self._actor.node.remote()
        if self._node:
            return True
        if not ray.wait([self._started], timeout=READY_POLL)[0] or self._closed:
            return False
        try:
            started: Any = ray.get(self._started)
            self._node, there = started
            if other := differences(there):  # a node that joined later
                name = self._node.partition(" ")[0]
                self.close()
                self._refused = f"node {name} has {other}; install the same there"
                return True
        except ray.exceptions.RayError as error:  # its node went before it began, or it cannot begin anywhere
            self.close()
            self._failures += 1
            self._refused = _reason(error) if self._failures >= MOST_FAILURES else ""
            return bool(self._refused)
        self._failures, self._refused = 0, ""
        return True

    def answer(self, task: dict[str, Any], timeout: float, why: str = "") -> dict[str, Any]:
        """As `task_list.Worker`; what the task wrote is written here."""
        import ray

        if self._refused:
            raise WorkerDied(self._refused)
        packs = [] if self.place.executor.shared else packs_of(self.common, task, self.place.roots)
        sent = [(pack, [reference(pack)]) for pack in packs]  # in a list: fetched by the node that lacks it
        call = self._actor.answer.remote(task, sent)
        try:
            reply: Any = ray.get(call, timeout=timeout)
        except ray.exceptions.GetTimeoutError:
            self.close()
            raise WorkerDied(f"worker hung for {timeout:.0f} s{why}") from None
        except ray.exceptions.RayTaskError as error:  # of our own code around the worker
            return {"error": f"{type(error.cause).__name__}: {error.cause}", "retry": True}
        except ray.exceptions.RayError as error:
            node = self._node
            self.close()
            if not self._closed and _node_is_gone(node):
                raise WorkerLost(f"node {node.partition(' ')[0]} is gone") from None
            raise WorkerDied(_reason(error)) from None
        if reply["log"]:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            with self.log.open("a") as sink:
                sink.write(reply["log"])
        try:
            receive(reply["written"], reply["removed"], self.place.roots)
        except OSError as error:
            return {"error": f"{error.strerror}: {error.filename}", "retry": False, "errno": error.errno}
        return {**reply["answer"], "node": self._node.partition(" ")[0]}

    def kill(self) -> None:
        self._closed = True
        self._end()

    def close(self, *, force: bool = True) -> None:
        import ray

        if not force and self._node and ray.is_initialized():
            with contextlib.suppress(ray.exceptions.RayError):
                ray.get(self._actor.close.remote(), timeout=CLOSE_WAIT)
        self._end()
        self._actor = self._started = None
        self._node = ""

    def _end(self) -> None:
        import ray

        actor = self._actor
        if actor is not None and ray.is_initialized():
            with contextlib.suppress(ray.exceptions.RayError, ValueError):
                ray.kill(actor)


def reference(pack: Pack) -> Any:
    """The pack in the object store, put there once as long as it stays what it is."""
    import ray

    if not pack.kept:
        return ray.put(packed(pack))
    with _SENDING:
        digest, sent = _SENT.get(pack.path, ("", None))
        if digest != pack.digest:
            sent = ray.put(packed(pack))
            _SENT[pack.path] = pack.digest, sent
        return sent


_SENT: dict[str, tuple[str, Any]] = {}
"""(digest, reference) by path: an object lives as long as its references."""
_SENDING = threading.Lock()


def _node_is_gone(node: str) -> bool:
    """Whether the node that an actor ran on is no longer part of the cluster; waits until it is clear.

    A node that Ray counts as alive after STATE_WAIT is there, however busy.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    number = node.partition(" ")[2]
    strategy = NodeAffinitySchedulingStrategy(number, soft=False)
    ask = ray.remote(num_cpus=0, max_retries=0)(installed).options(scheduling_strategy=strategy)
    until = time.monotonic() + STATE_WAIT
    call = ask.remote()
    while time.monotonic() < until:
        if not any(one["Alive"] for one in ray.nodes() if one["NodeID"] == number):
            return True
        if not ray.wait([call], timeout=READY_POLL)[0]:
            continue
        try:
            ray.get(call)
        except ray.exceptions.RayError:  # the node is going, or the process that was to answer died
            time.sleep(1)
            call = ask.remote()
        else:
            return False
    return False


def _reason(error: Exception) -> str:
    """How an actor ended, in a line, out of Ray's paragraphs."""
    import ray

    if isinstance(error, ray.exceptions.OutOfMemoryError):
        return "worker was ended for want of memory on its node"
    text = one_line(error)
    return "worker crashed" if "SYSTEM_ERROR" in text else f"worker ended: {text[:200]}"


class RemoteWorker:
    """The actor: `processes.Answerer` with the driver's files around it."""

    def __init__(self, module: str, common: dict[str, Any], roots: list[str], shared: bool) -> None:
        self.roots = [Path(root) for root in roots]
        self.mirror = None if shared else Mirror(cache_root() / "packs")
        temporary = tempfile.mkdtemp(prefix="dnrpipe-workers-", dir=self.mirror and self.mirror.folder)
        os.environ |= dict.fromkeys(("TMPDIR", "TEMP", "TMP"), temporary)
        tempfile.tempdir = None
        self.answerer = Answerer(module, self._there(common))
        # What libraries print goes back with the answers.
        self.output = tempfile.TemporaryFile("w+b", buffering=0)  # noqa: SIM115
        sys.stdout.flush()
        sys.stderr.flush()
        os.dup2(self.output.fileno(), 1)
        os.dup2(self.output.fileno(), 2)

    def node(self) -> tuple[str, dict[str, str]]:
        """(name and number of the node, what is installed there)."""
        import ray

        return f"{socket.gethostname()} {ray.get_runtime_context().get_node_id()}", installed()

    def answer(self, task: dict[str, Any], sent: list[tuple[Pack, list[Any]]]) -> dict[str, Any]:
        """-> the worker's answer, the files that it wrote and removed, and what it printed."""
        import ray

        if self.mirror is None:
            return {"answer": self.answerer(task), "written": {}, "removed": [], "log": self._printed()}
        for pack, (content,) in sent:
            self.mirror.place(pack, lambda content=content: ray.get(content))
        before = self.mirror.state()
        answer = self.answerer(self._there(task))
        written, removed = self.mirror.changes(before)
        logs = {root / "logs" for root in self.roots}  # the driver appends to its own
        for path in [path for path in written if Path(path).parent in logs]:
            sys.stdout.write(written.pop(path).decode(errors="replace"))
        sys.stdout.flush()
        root = str(self.mirror.root)
        answer = moved(answer, lambda text: text.replace(root, ""))
        return {"answer": answer, "written": written, "removed": removed, "log": self._printed()}

    def close(self) -> None:
        """Leave nothing behind."""
        if self.mirror is not None:
            self.mirror.close()

    def _there(self, values: Any) -> Any:
        """With the driver's paths as they are here."""
        mirror = self.mirror
        if mirror is None:
            return values
        return moved(values, lambda text: str(mirror.here(text)) if under(text, self.roots) else text)

    def _printed(self) -> str:
        size = self.output.seek(0, os.SEEK_END)
        self.output.seek(max(0, size - LOG_TAIL))
        text = self.output.read().decode(errors="replace")
        self.output.seek(0)
        self.output.truncate()
        return text
