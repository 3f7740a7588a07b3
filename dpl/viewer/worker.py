"""One thread that answers, and the newest wish wins: nothing is ever queued."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable

from dpl.viewer.drag_loads import LoadRequest
from dpl.viewer.frames import Body, Frame, ViewSettings, between

Make = Callable[[], LoadRequest]
NEAR = 1e-3  # part of the way at which a load has arrived


class Worker(threading.Thread):
    """Answers the newest load again and again until there is a newer one.

    The load glides: what is answered lies on the way from the last load to the newest, a little
    nearer with each frame, so that a hand that is heard 20 times a second moves a body that is
    drawn 60 times. Each frame is an answer of its own.

    Attributes:
        body: What answers.
    """

    def __init__(
        self,
        body: Body,
        show: Callable[[Frame], None],
        *,
        beside: Callable[[Frame | None], None] = lambda frame: None,
        trouble: Callable[[str], None] = lambda words: None,
        rate: float = 60.0,
        smoothing_time: float = 0.06,
        min_frame_time: float = 0.35,
    ) -> None:
        """Take where answers go.

        Args:
            body: What answers.
            show: Takes an answer.
            beside: Takes an iterate of Newton; None where there is none for this load.
            trouble: Takes why a load cannot be answered.
            rate: Most frames a second.
            glide: Time in which 63 % of the way to a new load is gone [s]; 0: at once.
            pace: Shortest time that an iterate is seen [s].
        """
        super().__init__(name="viewer", daemon=True)
        self.body, self._show, self._beside, self._trouble = body, show, beside, trouble
        self._rate, self._glide, self._pace = rate, smoothing_time, min_frame_time
        self._news = threading.Condition()
        self._make: Make = body.rest
        self._wish = ViewSettings()
        self._asked, self._done, self._ended = 1, 0, False  # numbers of wishes
        self._times: deque[float] = deque(maxlen=240)

    def ask(self, make: Make | None = None, wish: ViewSettings | None = None) -> None:
        """Replace load, wish or both; `make` is called by this thread."""
        with self._news:
            self._make = self._make if make is None else make
            self._wish = self._wish if wish is None else wish
            self._asked += 1
            self._news.notify_all()

    @property
    def wish(self) -> ViewSettings:
        """The newest."""
        return self._wish

    @property
    def rate(self) -> float:
        """Answers in the second before the last."""
        times = list(self._times)
        return float(sum(times[-1] - then < 1.0 for then in times))

    def settle(self, timeout: float) -> bool:
        """Wait until the newest wish is answered; return whether it is."""
        with self._news:
            return self._news.wait_for(lambda: self._done == self._asked, timeout)

    def stop(self) -> None:
        """End after the answer at work."""
        with self._news:
            self._ended = True
            self._news.notify_all()
        if self.is_alive():
            self.join(timeout=30)

    def run(self) -> None:
        """Answer until `stop`."""
        here: LoadRequest | None = None
        while True:
            with self._news:
                self._news.wait_for(lambda: self._ended or self._done != self._asked)
                if self._ended:
                    return
                number, make, wish = self._asked, self._make, self._wish
            try:
                here = self._serve(number, make, wish, here)
            except Exception as error:  # the page must go on, whatever one load did
                self._trouble(" ".join(str(error).split()) or type(error).__name__)
                self._finish(number)

    def _serve(
        self, number: int, make: Make, wish: ViewSettings, here: LoadRequest | None
    ) -> LoadRequest:
        """Go to a load, and return where the newer one found it."""
        goal = make()
        here = goal if here is None or self._glide <= 0 else here
        size = max(float(here.force.norm()), float(goal.force.norm())) or 1.0
        left = self._left(here, goal, size)
        self._beside(None)
        before = time.monotonic()
        while True:
            here = between(here, goal, 1.0 if left < NEAR else self._share(before))
            left = self._left(here, goal, size)
            before = time.monotonic()
            frame = self.body.answer(here, wish)
            self._times.append(time.monotonic())
            self._show(frame)
            if here is goal:
                break
            if self._interrupted(number, before + 1 / self._rate - time.monotonic()):
                return here
        if wish.compare:
            for iterate in self.body.newton(goal, wish, frame):
                if self._interrupted(number, 0.0):
                    return here
                self._beside(iterate)
                if self._interrupted(number, self._pace):
                    return here
        self._finish(number)
        return here

    def _share(self, before: float) -> float:
        """Return the part of the way that is gone in the time since the last frame."""
        since = max(time.monotonic() - before, 1 / self._rate)
        return 1 - math.exp(-since / self._glide)

    @staticmethod
    def _left(here: LoadRequest, goal: LoadRequest, size: float) -> float:
        """Return how far a load is from another, in parts of the larger force and of E."""
        way = float((goal.force - here.force).norm()) / size
        return max(way, abs(goal.young - here.young) / goal.young)

    def _interrupted(self, number: int, seconds: float) -> bool:
        """Wait so long for a newer wish; return whether there is one."""
        with self._news:
            return self._news.wait_for(
                lambda: self._ended or self._asked != number, max(seconds, 0.0)
            )

    def _finish(self, number: int) -> None:
        with self._news:
            self._done = number
            self._news.notify_all()
