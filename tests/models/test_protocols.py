"""Networks of other packages have a capability if they define its methods."""

import pytest
import torch

from dpl.fem import symmetries
from dpl.models import (
    CNN,
    FCNN,
    Correctable,
    PODNet,
    TrainsInCoordinates,
    Unrolled,
)
from dpl.training import MSE, LrStar, Surrogate

KINDS = Correctable, TrainsInCoordinates


class OwnNet(torch.nn.Module):
    """Network between coordinates that inherits from no class of the package."""

    extra_inputs = ()

    def __init__(self, scene):
        super().__init__()
        self.inner = PODNet(scene, rank=4, coordinates=4, width=8, blocks=1)

    @property
    def is_fitted(self):
        return self.inner.is_fitted

    @property
    def is_symmetric(self):
        return False

    def forward(self, force):
        return self.inner(force)

    def fit_bases(self, samples):
        self.inner.fit_bases(samples)

    def encode(self, samples):
        return self.inner.encode(samples)

    def network(self, inputs):
        return self.inner.network(inputs)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (FCNN, (False, False)),
        (CNN, (False, False)),
        (PODNet, (True, True)),
        (Unrolled, (True, False)),
        (OwnNet, (False, True)),
    ],
)
def test_capabilities_of_a_network_are_those_whose_methods_it_defines(scene, kind, expected):
    assert tuple(isinstance(kind(scene), protocol) for protocol in KINDS) == expected


def test_a_network_of_another_package_trains_in_coordinates(scene, batch):
    module = Surrogate(OwnNet(scene), MSE(), scene)
    module.log = lambda *_, **__: None
    assert not module.net.is_fitted
    module.fit_bases(batch)
    assert module.net.is_fitted
    reduced = module.encode(batch)
    loss = module.training_step(reduced.__getitems__([0, 1, 2]), 0)
    loss.backward()
    assert float(loss) > 0
    assert module.encode(batch, symmetries(scene.problem)) is None
    assert Surrogate(OwnNet(scene), LrStar(), scene).encode(batch) is None
