"""Networks of other packages have a capability if they define its methods."""

import torch

from dpl.training import MSE, Surrogate


class OwnNet(torch.nn.Module):
    """A network with bases that inherits from no class of the package."""

    def __init__(self):
        super().__init__()
        self.register_buffer("factor", torch.zeros(()))

    @property
    def is_fitted(self):
        return bool(self.factor > 0)

    def forward(self, field, scalars):
        return self.factor * field

    def fit_bases(self, field, output):
        self.factor.copy_((field * output).sum() / field.square().sum())


def test_bases_of_a_network_of_another_package_are_fitted_once(scene, batch):
    module = Surrogate(OwnNet(), MSE(), scene)
    assert module.predictor.lacks_bases
    module.fit_bases(batch)
    assert not module.predictor.lacks_bases
    field, output = module.predictor.examples(batch)
    error = output - float(module.net.factor) * field
    assert abs(float((error * field).sum())) < 1e-5 * float(output.norm() * field.norm())
