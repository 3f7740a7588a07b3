"""Thread that solves the most recent request; earlier requests are dropped."""

import math
import threading
import time
from collections.abc import Callable

from dpl.viewer.frames import Body, Frame, ViewSettings
from dpl.viewer.requests import LoadRequest, MakeRequest

ARRIVED = 1e-3  # relative distance below which the next frame is the requested one [-]
MAX_RATE = 60.0  # largest number of frames per second [1/s]


class Worker(threading.Thread):
    """Thread that solves loads and grasps on the way to the most recent request.

    A browser sends drag events 20 times per second. Loads and motions are smoothed exponentially in
    time, so that the body is drawn up to `MAX_RATE` times per second; each frame is solved.
    `settings` are the most recent ones.
    """

    smoothing_time = 0.06  # time constant of the smoothing [s]; 0: no smoothing
    min_frame_time = 0.35  # shortest time for which an iterate of Newton is shown [s]

    def __init__(
        self,
        body: Body,
        on_frame: Callable[[Frame], None],
        on_newton: Callable[[Frame | None], None] = lambda frame: None,
        on_error: Callable[[str], None] = lambda message: None,
    ) -> None:
        """Create the thread; `start` starts it.

        Frames, iterates of Newton (None when a new request is solved) and messages of requests
        that cannot be solved are passed to the functions.
        """
        super().__init__(name="viewer", daemon=True)
        self.body, self.settings = body, ViewSettings()
        self._on_frame, self._on_newton, self._on_error = on_frame, on_newton, on_error
        self._changed = threading.Condition()
        self._make_request: MakeRequest = body.zero_load
        self._submitted, self._finished, self._stopped = 1, 0, False  # counts of requests
        self._begin: float | None = None  # of the solve in progress [s]

    def submit(
        self, make_request: MakeRequest | None = None, settings: ViewSettings | None = None
    ) -> None:
        """Replace the request, which is made in this thread, the settings or both."""
        with self._changed:
            self._make_request = make_request or self._make_request
            self.settings = settings or self.settings
            self._submitted += 1
            self._changed.notify_all()

    @property
    def solving_time(self) -> float:
        """Time since the solve in progress began [s]; 0 if there is none."""
        begin = self._begin
        return 0.0 if begin is None else time.monotonic() - begin

    def wait(self, timeout: float) -> bool:
        """Wait until the most recent request is finished; return False after `timeout` [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._finished == self._submitted, timeout)

    def stop(self) -> None:
        """Stop after the solve in progress."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self.is_alive():
            self.join(timeout=30)

    def run(self) -> None:
        """Solve requests until `stop`."""
        current: LoadRequest | None = None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or self._finished != self._submitted)
                if self._stopped:
                    return
                number, make_request = self._submitted, self._make_request
                settings = self.settings
            self._begin = time.monotonic()
            finished = True
            try:
                current, finished = self._solve(number, make_request(), settings, current)
            except Exception as error:  # one failed request must not end the thread
                self._on_error(" ".join(str(error).split()) or type(error).__name__)
            self._begin = None
            if finished:
                with self._changed:
                    self._finished = number
                    self._changed.notify_all()

    def _solve(
        self, number: int, goal: LoadRequest, settings: ViewSettings, start: LoadRequest | None
    ) -> tuple[LoadRequest, bool]:
        """Solve from `start` to `goal`; return the last request, and False for a newer request."""
        if start is None or self.smoothing_time <= 0 or not goal.continues(start):
            start = goal
        self._on_newton(None)
        current, distance, before = start, start.distance(goal), time.monotonic()
        rest = 1.0  # share of the way that is left
        while True:
            elapsed = max(time.monotonic() - before, 1 / MAX_RATE)
            if rest * distance < ARRIVED:
                current = goal
            else:
                rest *= math.exp(-elapsed / self.smoothing_time)
                current = start.interpolate(goal, 1 - rest)
            self._begin = before = time.monotonic()
            frame = self.body.solve(current, settings)
            self._on_frame(frame)
            if current is goal:
                break
            if self._is_replaced(number, before + 1 / MAX_RATE - time.monotonic()):
                return current, False
        self._begin = None
        iterates = self.body.newton_frames(goal, settings, frame) if settings.show_newton else ()
        for iterate in iterates:
            if self._is_replaced(number, 0.0):
                return current, False
            self._on_newton(iterate)
            if self._is_replaced(number, self.min_frame_time):
                return current, False
        return current, True

    def _is_replaced(self, number: int, seconds: float) -> bool:
        """Wait for a newer request; return True if there is one or the thread must stop."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._stopped or self._submitted != number, max(seconds, 0.0)
            )
