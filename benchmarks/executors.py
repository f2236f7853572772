"""Executes jobs: in processes of this machine, or on a Ray or Dask cluster.

If a worker dies, its job is given to another one. There it continues from its checkpoint if both workers see the same
folder, and starts again if not. Results come back with the outcome, so a cluster needs no shared folder; a job whose
file in this machine's folder is not its own result fails here.
"""

import importlib
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

from benchmarks.jobs import Folders, Job, Outcome, execute, failed, refusal
from gym_dgpmpc.errors import DGPMPCError

RETRIES = 10
"""How often a job is started again because its worker died."""
LOSSES_TOGETHER = 2
"""How often jobs on this machine are started again together, before each is tried alone to find the culprit."""
OBJECT_STORE_BYTES = 100 << 20
"""Ray's shared memory on this machine; the results of jobs are a few kilobytes each."""

PACKAGE_OF = {"bench": "joblib", "ray": "ray", "dask": "distributed"}
"""What executors need, by the extra that brings it."""

Executor = Callable[[Sequence[Job], Folders], Iterator[tuple[Job, Outcome]]]
"""Executes jobs in any order, and yields each with its outcome as it ends."""


class ClusterError(DGPMPCError, ValueError):
    """A cluster cannot be used, or its address is not valid."""


def executor(num_processes: int, cluster: str | None = None) -> Executor:
    """The executor for a place.

    Args:
        num_processes: jobs at a time; a single one is done in this process. An existing cluster has a size of its own,
            which counts instead.
        cluster: None for this machine; "ray" for the Ray cluster that the variable RAY_ADDRESS names, or else a new one
            on this machine; "ray://HOST:PORT" for Ray's client; "dask" for a new Dask cluster on this machine;
            "tcp://HOST:PORT" (or "tls://...") for the Dask scheduler there.

    Raises:
        ClusterError: the address has none of these forms, or the package that it needs is not installed.
    """
    return refuse_foreign_files(_executor_at(cluster, num_processes))


def refuse_foreign_files(execute_all: Executor) -> Executor:
    """The same executor, but a job whose file is not its own result fails at once and is given to no worker.

    A worker with folders of its own does not see that file, and what it sends back would replace it.
    """

    def execute_allowed(jobs: Sequence[Job], folders: Folders) -> Iterator[tuple[Job, Outcome]]:
        allowed = []
        for job in jobs:
            outcome = refusal(job, folders.results)
            if outcome is None:
                allowed.append(job)
            else:
                yield job, outcome
        if allowed:
            yield from execute_all(allowed, folders)

    return execute_allowed


def _executor_at(cluster: str | None, num_processes: int) -> Executor:
    if cluster is None:
        _need("bench")
        return lambda jobs, folders: _on_this_machine(jobs, folders, num_processes)
    if cluster == "ray" or cluster.startswith("ray://"):
        _need("ray")
        return lambda jobs, folders: _on_ray(jobs, folders, None if cluster == "ray" else cluster, num_processes)
    if cluster == "dask" or cluster.startswith(("tcp://", "tls://")):
        _need("dask")
        return lambda jobs, folders: _on_dask(jobs, folders, None if cluster == "dask" else cluster, num_processes)
    raise ClusterError(f"expected ray, ray://HOST:PORT, dask or tcp://HOST:PORT as the cluster, got {cluster!r}")


def _need(extra: str) -> None:
    try:
        importlib.import_module(PACKAGE_OF[extra])
    except ModuleNotFoundError as error:
        raise ClusterError(f'{error.name} is not installed: in the clone, run `pip install -e ".[{extra}]"`') from error


def _on_this_machine(jobs: Sequence[Job], folders: Folders, num_processes: int) -> Iterator[tuple[Job, Outcome]]:
    # Here, so that a cluster does not need joblib.
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    left, losses = list(jobs), 0
    while left:
        together = losses < LOSSES_TOGETHER
        # A process that dies takes its pool with it, and the pool does not say which job killed it.
        batch = list(left) if together else left[:1]
        processes = num_processes if together else max(num_processes, 2)  # a single one would be this process
        try:
            with parallel_config(backend="loky", inner_max_num_threads=1):
                pool = Parallel(processes, return_as="generator_unordered", batch_size=1, pre_dispatch=processes)
            for index, outcome in pool(delayed(_numbered)(i, job, folders) for i, job in enumerate(batch)):
                left.remove(batch[index])
                losses = 0
                yield batch[index], outcome
        except TerminatedWorkerError as error:
            losses += 1
            if losses > LOSSES_TOGETHER + RETRIES:
                losses = 0
                yield left.pop(0), failed(error)


def _numbered(index: int, job: Job, folders: Folders) -> tuple[int, Outcome]:
    return index, execute(job, folders)


def _on_ray(
    jobs: Sequence[Job], folders: Folders, address: str | None, num_processes: int
) -> Iterator[tuple[Job, Outcome]]:
    import ray

    starts = not ray.is_initialized()
    if starts:
        _connect_to_ray(address, num_processes)
    try:
        # Ray starts a task again if its worker dies; failures of the job itself are outcomes, not exceptions.
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(execute)
        pending = {task.remote(job, folders): job for job in jobs}
        while pending:
            (ended,), _ = ray.wait(list(pending), num_returns=1)
            job = pending.pop(ended)
            try:
                outcome = ray.get(ended)
            except ray.exceptions.RayError as error:
                outcome = failed(error)
            yield job, outcome
    finally:
        if starts:
            ray.shutdown()


def _connect_to_ray(address: str | None, num_processes: int) -> None:
    import ray

    try:
        if address is not None or "RAY_ADDRESS" in os.environ:
            ray.init(address)
            return
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster for one command sends no statistics
        ray.init(
            num_cpus=num_processes,
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            logging_level=logging.ERROR,
            log_to_driver=False,
        )
    except (ConnectionError, OSError, RuntimeError) as error:
        raise ClusterError(f"there is no Ray cluster at {address or os.environ.get('RAY_ADDRESS')}: {error}") from error


def _on_dask(
    jobs: Sequence[Job], folders: Folders, address: str | None, num_processes: int
) -> Iterator[tuple[Job, Outcome]]:
    from distributed import Client, Future, KilledWorker, LocalCluster, as_completed

    with ExitStack() as stack:
        scheduler: Any = address
        if address is None:
            local = LocalCluster(
                n_workers=num_processes, threads_per_worker=1, dashboard_address=None, silence_logs="ERROR"
            )
            scheduler = stack.enter_context(local)
        try:
            client = stack.enter_context(Client(scheduler))
        except OSError as error:
            raise ClusterError(f"there is no Dask scheduler at {address}: {error}") from error

        def submit(job: Job) -> Future:
            return client.submit(execute, job, folders, pure=False)

        pending, losses = {submit(job): job for job in jobs}, dict.fromkeys((job.file_name for job in jobs), 0)
        completed = as_completed(list(pending))
        for ended in completed:
            job = pending.pop(ended)
            try:
                yield job, ended.result()
            # Dask starts a task again by itself, but only as often as its scheduler is configured to.
            except KilledWorker as error:
                losses[job.file_name] += 1
                if losses[job.file_name] > RETRIES:
                    yield job, failed(error)
                    continue
                again = submit(job)
                pending[again] = job
                completed.add(again)
            except Exception as error:  # such as a module that is missing on the worker
                yield job, failed(error)
