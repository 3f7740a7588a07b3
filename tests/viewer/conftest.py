"""Bodies whose predictions have an error of 2 %, and a page."""

import pytest
import torch

from dpl.fem import solve
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate
from dpl.viewer import Body


def make_body_of(scene) -> Body:
    torch.manual_seed(0)
    surrogate = Surrogate(FCNN(scene, width=4), MSE(), scene)
    surrogate.predict = lambda load: 0.98 * solve(scene.solver, load).displacement
    return Body(Simulator(surrogate))


@pytest.fixture(scope="session")
def make_body():
    """Function that returns the body of a scene."""
    return make_body_of


@pytest.fixture(scope="session")
def body(scene):
    """The tiny beam."""
    return make_body_of(scene)


@pytest.fixture
def page(body, tmp_path):
    """A page of the tiny beam at a free port."""
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from dpl.viewer import AccessPolicy, Page

    page = Page(body, AccessPolicy.bind("127.0.0.1", 0), title="tiny", folder=tmp_path / "view")
    yield page
    page.close()
