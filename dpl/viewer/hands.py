"""Modes of a drag: the hand pulls the body by a load on a patch, or grasps the patch.

A hand `take`s a node of the shown body, `move`s it with the mouse, and `hold`s the patch as the
sliders say; the two latter return requests, which the worker makes.
"""

from functools import partial

import numpy as np
import torch
from torch import Tensor

from dpl.viewer.controls import Controls
from dpl.viewer.frames import Body, Frame
from dpl.viewer.requests import MakeRequest, Patch


class _Hand:
    """The body, the controls of the patch and the displacement at the begin of a drag over L."""

    def __init__(self, body: Body, controls: Controls) -> None:
        self._body, self._controls = body, controls
        self._start = torch.zeros(body.scene.problem.shape[1]).double()

    def _patch(self, node: int) -> Patch:
        return self._body.patch(node, self._controls.radius)


class PullingHand(_Hand):
    """Converts drags and sliders to modal loads on a patch."""

    def take(self, node: int, frame: Frame) -> int:
        """Begin a drag at a node of the shown body; return the node at the centre of the patch."""
        self._node, self._start = node, frame.displacement[node] / self._body.scene.length
        return node

    def move(self, motion: Tensor) -> MakeRequest:
        """Return the load whose linear response moves the dragged point to the mouse.

        `motion` is that of the mouse over L since `take`, (D,) [-].
        """
        target, controls = self._start + motion, self._controls
        if size := float(target.norm()):
            direction = np.pad((target / size).numpy(), (0, 3 - len(target)))
            controls.direction.value = tuple(direction.round(2).tolist())
        controls.follows_frame = True
        patch = self._patch(self._node)
        return lambda: self._body.request(patch.force_towards(target))

    def hold(self, node: int, frame: Frame | None) -> MakeRequest:
        """Return the load of the sliders for direction and amplitude."""
        patch, controls = self._patch(node), self._controls
        controls.follows_frame = False
        direction = torch.tensor(controls.direction.value[: len(self._start)]).double()
        amplitude = controls.amplitude.value
        return lambda: self._body.request(patch.force_along(direction, amplitude))

    def marked_nodes(self, node: int) -> Tensor:
        """Mask of the loaded nodes, (N,)."""
        return self._patch(node).node_mask


class GraspingHand(_Hand):
    """Converts drags and sliders to rigid motions of a patch, which it holds until `release`."""

    _held: int | None = None  # node at the centre of the held patch
    _translation: Tensor

    def take(self, node: int, frame: Frame) -> int:
        """Hold the patch of the node; a drag within the held patch keeps it."""
        if self._held is None or not self._patch(self._held).node_mask[node]:
            self._held = self._grip(node, frame)
        self._start = self._translation
        return self._held

    def move(self, motion: Tensor) -> MakeRequest:
        """Return the grasp whose translation is that at `take` plus the motion."""
        self._translation = self._start + motion
        return self._request()

    def hold(self, node: int, frame: Frame | None) -> MakeRequest:
        """Return the grasp of the patch of a node, rotated by the angle of the slider."""
        if node != self._held:
            self._held = self._grip(node, frame)
        return self._request()

    def release(self) -> None:
        """Forget the patch, because another load replaces the request."""
        self._held = None

    def marked_nodes(self, node: int) -> Tensor:
        """Mask of the held nodes, (N,)."""
        patch = self._patch(node)
        return patch.sliding_nodes if self._controls.sliding.value else patch.held_nodes

    def _grip(self, node: int, frame: Frame | None) -> int:
        """Hold the patch of a node where a frame shows it, without a rotation; return the node."""
        held = self.marked_nodes(node)
        self._translation = torch.zeros_like(self._start)
        if frame is not None and held.any():
            self._translation = frame.displacement[held].mean(dim=0) / self._body.scene.length
        self._controls.angle.value = 0.0
        return node

    def _request(self) -> MakeRequest:
        """Return the request of the held patch with the rotation of the controls."""
        assert self._held is not None
        self._controls.follows_frame = False
        nodes, sliding = self.marked_nodes(self._held), bool(self._controls.sliding.value)
        motion = self._translation, self._controls.rotation
        return partial(self._body.grasp, nodes, *motion, sliding=sliding)
