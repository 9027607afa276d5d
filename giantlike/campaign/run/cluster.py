"""The work of a run on the workers of a dask.distributed cluster."""

from __future__ import annotations

import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import cv2

from giantlike._system.processes import one_thread
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.pool import Jobs
from giantlike.campaign.run.worker_context import Workbench
from giantlike.core.errors import InputError
from giantlike.core.extras import require_extra

if TYPE_CHECKING:
    from distributed import Client

Job = TypeVar("Job")
Answer = TypeVar("Answer")

_QUEUED_PER_WORKER = 4  # jobs handed out per worker: one at work, some on the way over slow networks
_CONNECT_S = 30.0  # longest wait for the scheduler to answer, and for its first worker

_campaigns: dict[str, Campaign] = {}
_benches: dict[str, Workbench] = {}
_one_at_a_time = threading.Lock()  # CSPICE and caches of tracers are for one thread: jobs take turns


class DaskPool:
    """Runs jobs on images on the workers of a cluster; use it in a ``with`` block.

    Files have the same paths on all workers; this process alone writes the run folder. The jobs of a worker that dies
    go to others; a job that kills several in a row is given up.
    """

    def __init__(self, bench: Workbench, address: str) -> None:
        self._campaign = bench.campaign
        self._address = address
        self._token = uuid.uuid4().hex
        self._client: Client | None = None

    def __enter__(self) -> Self:
        require_extra("distributed", extra="dask", purpose="--dask")
        from distributed import Client, WorkerPlugin

        class Setup(WorkerPlugin):  # type: ignore[misc]  # the package is optional, and unknown to mypy
            """Gives a worker, one that comes later too, the campaign."""

            def __init__(self, token: str, campaign: Campaign) -> None:
                self.token, self.campaign = token, campaign

            def setup(self, worker: Any) -> None:
                """Keep the campaign; it is loaded with the first job."""
                from giantlike.campaign.run.cluster import keep_campaign

                keep_campaign(self.token, self.campaign)

        by_file = self._address.endswith(".json")
        if by_file and not Path(self._address).is_file():  # the client would wait for it without end
            raise InputError(f"--dask {self._address}: there is no such scheduler file; is the scheduler running?")
        known = {"scheduler_file": self._address} if by_file else {"address": self._address}
        try:
            client = Client(**known, timeout=_CONNECT_S, set_as_default=False)
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"--dask {self._address}: no scheduler with a worker answers there: {error}") from error
        client.register_plugin(Setup(self._token, self._campaign), name=self._token)
        self._client = client
        return self

    def __exit__(self, *_: object) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.run(forget_campaign, self._token, on_error="ignore")
            client.unregister_worker_plugin(self._token)
            client.close()

    def run(self, function: Callable[[Workbench, Job], Answer], jobs: Jobs[Job]) -> Iterator[tuple[int, Answer | None]]:
        """Yield the position and answer of each job, None if workers died of it, in the order of completion."""
        from distributed import as_completed
        from distributed.scheduler import KilledWorker

        client = self._client
        assert client is not None
        waiting = deque(range(len(jobs)))
        running: dict[Any, int] = {}
        done = as_completed(loop=client.loop)

        def hand_out() -> None:
            limit = _QUEUED_PER_WORKER * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
            while waiting and len(running) < limit:
                position = waiting.popleft()
                future = client.submit(_call, self._token, function, jobs[position], pure=False)
                running[future] = position
                done.add(future)

        hand_out()
        while running:
            future = next(done)
            position = running.pop(future)
            try:
                answer = future.result()
            except KilledWorker:
                answer = None
            hand_out()
            yield position, answer


def keep_campaign(token: str, campaign: Campaign) -> None:
    """Keep the campaign that the jobs of a run are of; called on a worker."""
    _campaigns[token] = campaign


def forget_campaign(token: str) -> None:
    """Free the data loaded for a run; called on a worker."""
    with _one_at_a_time:
        _campaigns.pop(token, None)
        bench = _benches.pop(token, None)
        if bench is not None:
            bench.close()


def _call(token: str, function: Callable[[Workbench, Any], Answer], job: Any) -> Answer:
    with _one_at_a_time:
        if token not in _benches:
            cv2.setNumThreads(1)
            _benches[token] = Workbench.load(_campaigns[token])
        with one_thread():
            return function(_benches[token], job)
