"""Thread that solves the most recent request; earlier requests are dropped."""

import math
import threading
import time
from collections.abc import Callable

from dpl.viewer.frames import Body, Frame, ViewSettings
from dpl.viewer.requests import MakeRequest, ViewRequest, distance, interpolate, scale_of

ARRIVED = 1e-3  # relative distance below which the next frame is the requested one


class Worker(threading.Thread):
    """Thread that solves loads and grasps on the way to the most recent request.

    A browser sends drag events 20 times per second. Loads and motions are smoothed exponentially in
    time, so that the body is drawn up to `max_rate` times per second; each frame is solved.

    Attributes:
        body: The body.
    """

    def __init__(
        self,
        body: Body,
        on_frame: Callable[[Frame], None],
        on_newton: Callable[[Frame | None], None] = lambda frame: None,
        on_error: Callable[[str], None] = lambda message: None,
        *,
        max_rate: float = 60.0,
        smoothing_time: float = 0.06,
        min_frame_time: float = 0.35,
    ) -> None:
        """Create the thread; `start` starts it.

        Args:
            body: The body.
            on_frame: Receives each frame.
            on_newton: Receives each iterate of Newton; None when a new request is solved.
            on_error: Receives the message of a request that cannot be solved.
            max_rate: Largest number of frames per second [1/s].
            smoothing_time: Time constant of the smoothing [s]; 0: no smoothing.
            min_frame_time: Shortest time for which an iterate of Newton is shown [s].
        """
        super().__init__(name="viewer", daemon=True)
        self.body, self.min_frame_time = body, min_frame_time
        self._on_frame, self._on_newton, self._on_error = on_frame, on_newton, on_error
        self._max_rate, self._smoothing_time = max_rate, smoothing_time
        self._changed = threading.Condition()
        self._make_request: MakeRequest = body.zero_load
        self._settings = ViewSettings()
        self._submitted, self._finished, self._stopped = 1, 0, False  # counts of requests
        self._begin: float | None = None  # of the solve in progress [s]

    def submit(
        self, make_request: MakeRequest | None = None, settings: ViewSettings | None = None
    ) -> None:
        """Replace the request, which is made in this thread, the settings or both."""
        with self._changed:
            self._make_request = make_request or self._make_request
            self._settings = settings or self._settings
            self._submitted += 1
            self._changed.notify_all()

    @property
    def settings(self) -> ViewSettings:
        """The most recent settings."""
        return self._settings

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
        current: ViewRequest | None = None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or self._finished != self._submitted)
                if self._stopped:
                    return
                number, make_request = self._submitted, self._make_request
                settings = self._settings
            self._begin = time.monotonic()
            try:
                current = self._solve(number, make_request(), settings, current)
            except Exception as error:  # one failed request must not end the thread
                self._on_error(" ".join(str(error).split()) or type(error).__name__)
                self._finish(number)

    def _solve(
        self, number: int, goal: ViewRequest, settings: ViewSettings, current: ViewRequest | None
    ) -> ViewRequest:
        """Solve from `current` to `goal` until a newer request; return what was solved last."""
        if current is None or self._smoothing_time <= 0 or not goal.continues(current):
            current = goal
        scale = scale_of(current, goal)
        self._on_newton(None)
        start = time.monotonic()
        while True:
            arrived = distance(current, goal, scale) < ARRIVED
            current = interpolate(current, goal, 1.0 if arrived else self._smoothing(start))
            self._begin = start = time.monotonic()
            frame = self.body.solve(current, settings)
            self._on_frame(frame)
            if current is goal:
                break
            if self._is_replaced(number, start + 1 / self._max_rate - time.monotonic()):
                return current
        self._begin = None
        if settings.show_newton:
            for iterate in self.body.newton_frames(goal, settings, frame):
                if self._is_replaced(number, 0.0):
                    return current
                self._on_newton(iterate)
                if self._is_replaced(number, self.min_frame_time):
                    return current
        self._finish(number)
        return current

    def _smoothing(self, start: float) -> float:
        """Return the share of the remaining distance for the time since `start`."""
        elapsed = max(time.monotonic() - start, 1 / self._max_rate)
        return 1 - math.exp(-elapsed / self._smoothing_time)

    def _is_replaced(self, number: int, seconds: float) -> bool:
        """Wait for a newer request; return True if there is one or the thread must stop."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._stopped or self._submitted != number, max(seconds, 0.0)
            )

    def _finish(self, number: int) -> None:
        self._begin = None
        with self._changed:
            self._finished = number
            self._changed.notify_all()
