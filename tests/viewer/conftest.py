"""Bodies whose predictions have an error of 2 %, and their pages."""

import pytest
import torch

from dpl.fem import solve
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate
from dpl.viewer import Body


def make_body_of(scene) -> Body:
    torch.manual_seed(0)
    surrogate, known = Surrogate(FCNN(scene, width=4), MSE(), scene), {}

    def predict(load):
        key = load.force.numpy().tobytes() + load.parameters.numpy().tobytes()
        if key not in known:
            known[key] = 0.98 * solve(scene.solver, load).displacement
        return known[key].clone()

    surrogate.predict = predict
    return Body(Simulator(surrogate))


def page_of(body, folder):
    """Return a page at a free port, whose worker solves each request at once."""
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from dpl.viewer import AccessPolicy, Page

    page = Page(body, AccessPolicy.bind("127.0.0.1", 0), title="tiny", folder=folder)
    page.worker.smoothing_time = 0.0
    return page


@pytest.fixture(scope="session")
def make_page():
    """Function that returns the page of a body; to be closed."""
    return page_of


@pytest.fixture(scope="session")
def make_body():
    """Function that returns the body of a scene."""
    return make_body_of


@pytest.fixture(scope="session")
def body(scene):
    """The tiny beam."""
    return make_body_of(scene)


@pytest.fixture(scope="session")
def tip(body):
    """The node at the middle of the end of the tiny beam."""
    return int(body.surface.nodes[body.surface.undeformed[:, 0].argmax()])
