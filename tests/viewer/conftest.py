"""A body whose network is the truth to a few per cent, and pages of it."""

import pytest
import torch

from dpl.fem import solve
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate
from dpl.viewer import Body


def body_of(scene) -> Body:
    torch.manual_seed(0)
    surrogate = Surrogate(FCNN(scene, width=4), MSE(), scene)
    surrogate.predict = lambda load: 0.98 * solve(scene.solver, load).displacement
    return Body(Simulator(surrogate))


@pytest.fixture(scope="session")
def make_body():
    """Makes bodies of scenes."""
    return body_of


@pytest.fixture(scope="session")
def body(scene):
    """The tiny beam."""
    return body_of(scene)


@pytest.fixture
def page(body, tmp_path):
    """A page of the tiny beam, at any free port."""
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from dpl.viewer import AccessPolicy, Page

    page = Page(body, AccessPolicy.bound("127.0.0.1", 0), title="tiny", folder=tmp_path / "view")
    yield page
    page.close()
