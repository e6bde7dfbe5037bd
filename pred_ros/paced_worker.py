"""A thread that owns something which is not thread-safe: does the jobs it is given and, on a free clock, ticks."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future

from pred_core.errors import BagError, ConfigError, InputError, PredError

Job = Callable[[], str]
LATE = 0.2  # [s] behind its schedule: what is more is not caught up
WINDOW = 1.0  # [s] over which the real-time factor is taken
IDLE = 0.05  # [s] between looks at `halt` while nothing is to be done
ANSWER = 60.0  # [s] for a job that somebody waits for


class PacedWorker:
    """`tick` advances by `period` [s] each time; `factor` says how fast that shall go, None: not by itself."""

    def __init__(
        self,
        tick: Callable[[], None],
        period: float,
        factor: Callable[[], float | None],
        refused: Callable[[PredError], None],
        last: Callable[[], None],
    ):
        """refused: told of every job that raised; last: called at the end, in the thread."""
        self._tick, self._period, self._factor = tick, period, factor
        self._refused, self._last = refused, last
        self._jobs: queue.Queue[tuple[Job, Future[str]]] = queue.Queue()
        self._halt = threading.Event()
        self.real_time_factor = math.nan
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="paced", daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> Future[str]:
        """Have a job done between two ticks."""
        done: Future[str] = Future()
        self._jobs.put((job, done))
        return done

    def ask(self, job: Job) -> tuple[bool, str]:
        """Have it done and wait: whether it was, and its line or the error's."""
        if not self._thread.is_alive():
            return False, "not active"
        try:
            return True, self.submit(job).result(ANSWER)
        except PredError as error:
            return False, str(error)
        except TimeoutError:
            return False, f"not done within {ANSWER:g} s"

    def end(self) -> None:
        """Stop and join."""
        self._halt.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._loop()
        except BaseException as error:  # whoever watches raises it again
            self.failure = error
        finally:
            self._last()

    def _loop(self) -> None:
        due = mark = time.monotonic()
        ticks = 0
        while not self._halt.is_set():
            factor = self._factor()
            now = time.monotonic()
            self._do_job(IDLE if factor is None else due - now)
            if factor is None:
                continue
            now = time.monotonic()
            if now < due:
                continue
            self._tick()
            ticks += 1
            due = max(due + self._period / factor, now - LATE)
            if now - mark > WINDOW:
                self.real_time_factor, mark, ticks = ticks * self._period / (now - mark), now, 0

    def _do_job(self, patience: float) -> None:
        try:
            job, done = self._jobs.get(timeout=patience) if patience > 0.0 else self._jobs.get_nowait()
        except queue.Empty:
            return
        try:
            done.set_result(job())
        except (BagError, ConfigError, InputError) as error:  # the rest ends the node
            done.set_exception(error)
            self._refused(error)
