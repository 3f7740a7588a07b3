"""docs/inverse.md as it stands, and the gradients of surrogates that it relies on."""

import re
from pathlib import Path

import pytest
import torch

from dpl.models import FCNN
from dpl.training import MSE, Surrogate

PAGE = Path(__file__).parents[2] / "docs" / "inverse.md"


@pytest.fixture(scope="module")
def page():
    """The names that the page's code has made, run from top to bottom."""
    names = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL):
        exec(compile(block, str(PAGE), "exec"), names)
    return names


@pytest.fixture(scope="module")
def untrained(scene):
    torch.manual_seed(0)
    return Surrogate(FCNN(scene, width=16), MSE(), scene).double()


@pytest.fixture(scope="module")
def acting(scene, batch):
    """Two loads in newtons, on two bodies of unlike moduli."""
    young = torch.tensor([4500.0, 9000.0], dtype=torch.float64)
    return batch.force[:2] * (young * scene.force_unit)[:, None, None], young


def test_the_modulus_comes_back(page):
    assert float(page["young"]) == pytest.approx(3.7e6, rel=1e-6)
    assert 0.1 < float(page["seen"].abs().max()) < 0.4  # large displacements, no linear matter


def test_the_surrogate_finds_the_modulus_as_well_as_it_predicts(page):
    assert float(page["guess"]) == pytest.approx(3.7e6, rel=0.1)
    assert float(page["guess"]) != pytest.approx(3.7e6, rel=1e-6)


def test_the_traction_comes_back(page):
    assert page["traction"].tolist() == pytest.approx(page["pulled"].tolist(), rel=1e-6)
    assert float(page["observed"].abs().max()) > 0.01  # [m]


def test_gradients_of_a_surrogate_are_those_of_differences(untrained, acting):
    newtons, young = (one.clone().requires_grad_() for one in acting)
    weight = torch.randn(newtons.shape, generator=torch.Generator().manual_seed(1)).double()

    def seen(newtons, young):
        return (untrained(newtons, young) * weight).sum(dim=(1, 2))

    by_force, by_young = torch.autograd.grad(seen(newtons, young).sum(), (newtons, young))
    way = torch.randn(newtons.shape, generator=torch.Generator().manual_seed(2)).double()
    way *= acting[0].norm() / way.norm()
    step = 1e-6
    with torch.no_grad():
        up, down = (seen(newtons + s * way, young) for s in (step, -step))
        assert torch.allclose((by_force * way).sum(dim=(1, 2)), (up - down) / (2 * step), rtol=1e-5)
        up, down = (seen(newtons, young * (1 + s)) for s in (step, -step))
        assert torch.allclose(by_young * young, (up - down) / (2 * step), rtol=1e-5)


def test_gradients_of_a_surrogate_in_single_precision_are_near_those_in_double(scene, acting):
    torch.manual_seed(0)
    module = Surrogate(FCNN(scene, width=16), MSE(), scene)

    def slopes(net):
        inner = [one.clone().requires_grad_() for one in acting]
        return torch.autograd.grad(net(*inner).square().sum(), inner)

    for single, double in zip(slopes(module), slopes(module.double()), strict=True):
        assert not torch.equal(single, double)
        assert single.dtype == torch.float64
        assert torch.allclose(single, double, rtol=1e-3, atol=1e-4 * float(double.abs().max()))
