"""Networks, losses and metrics follow the surrogate to its device, and a GPU computes the same.

Tests without the mark `gpu` use PyTorch's meta device in place of a GPU: its tensors have no
values, and an operation that mixes it with the CPU raises an error.
"""

import json
from functools import partial

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from dpl.fem import LinearSolver, Load
from dpl.models import CNN, FCNN, GNN, PODNet, Unrolled
from dpl.scene import Sample
from dpl.training import (
    MSE,
    EnergyNormLoss,
    LrPlus,
    LrStar,
    OnLinearSolution,
    PotentialEnergyLoss,
    Surrogate,
)

NETWORKS = {
    "fcnn": partial(FCNN, width=16),
    "fcnn full": partial(FCNN, all_dofs=True),
    "cnn": partial(CNN, channels=4),
    "gnn": partial(GNN, width=8),
    "pod": partial(PODNet, width=16, blocks=1),
}
LOSSES = [MSE, LrStar, LrPlus, EnergyNormLoss, PotentialEnergyLoss]
NO_GPU = "needs a CUDA device: torch.cuda.is_available() is false"
gpu = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason=NO_GPU),
]


def moved(batch, device):
    return Sample(*(column.to(device) for column in batch))


@pytest.fixture(params=[*NETWORKS, "fcnn linear", "cnn linear", "gnn linear", "pod linear"])
def surrogate(request, scene, batch):
    """A surrogate of each network, with bases where it has some."""
    torch.manual_seed(0)
    name, is_linear, _ = request.param.partition(" linear")
    base = "linear" if is_linear else None
    module = Surrogate.from_network(NETWORKS[name], MSE(), scene, base=base)
    if module.predictor.lacks_bases:
        module.predictor.fit_bases(batch)
    return module


def test_no_operation_of_a_training_step_mixes_devices(surrogate, batch):
    linear = batch.displacement.to("meta")  # the host computes linear solutions from values
    surrogate.to("meta")
    inputs = moved(batch, "meta")
    with FakeTensorMode(allow_non_fake_inputs=True):
        known = (linear,) if isinstance(surrogate.predictor, OnLinearSolution) else ()
        prediction = surrogate.predictor(inputs.load, *known)
        loss = surrogate.loss(prediction, inputs, surrogate.physics)
        loss.backward()
    assert {prediction.device.type, loss.device.type} == {"meta"}
    assert all(weights.grad is not None for weights in surrogate.net.parameters())


def test_problem_of_loss_and_metrics_follow_the_surrogate_and_return(scene):
    module = Surrogate(FCNN(scene, width=8), MSE(), scene)
    for device in ("meta", "cpu"):
        if device == "meta":
            module.to(device)
        else:  # tensors of the meta device have no values that could return
            module.to_empty(device=device)
        for problem in (module.physics.problem, module.metrics.problem):
            assert problem.points.device.type == problem.free.device.type == device
    assert module.double().physics.problem is scene.problem, "no copy is made"


# ------------------------------------------------------------------ on a GPU


@pytest.fixture
def exact_products():
    """Convolutions without TF32, whose products have eleven bits."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32 = before


def relative(found, expected):
    return float((found.cpu().double() - expected).norm() / expected.norm())


class TestGPU:
    pytestmark = gpu

    def test_predictions_equal_those_of_the_cpu(self, surrogate, batch, exact_products):
        surrogate.eval()
        with torch.no_grad():
            expected = surrogate.predict(batch.load)
            surrogate.to("cuda")
            found = surrogate.predict(moved(batch, "cuda").load)
        assert found.device.type == "cuda"
        assert relative(found, expected) < 1e-5

    def test_unrolled_predicts_as_its_compiled_loops(self, scene, batch):
        net = Unrolled(scene)
        net.fit(batch, batch)
        module = Surrogate(net, MSE(), scene).eval()
        with torch.no_grad():
            expected = module.predict(batch.load)
            found = module.to("cuda").predict(moved(batch, "cuda").load)
        assert found.device.type == "cuda"
        assert relative(found, expected) < 1e-6

    @pytest.mark.parametrize("loss", LOSSES)
    def test_loss_and_gradients_equal_those_of_the_cpu(self, scene, batch, loss, exact_products):
        torch.manual_seed(0)
        module = Surrogate(FCNN(scene, width=16), loss(), scene)
        results = []
        for device in ("cpu", "cuda"):
            module.to(device).zero_grad(set_to_none=True)
            inputs = moved(batch, device)
            value = module.loss(module.predict(inputs.load), inputs, module.physics)
            value.backward()
            gradient = torch.cat([p.grad.flatten() for p in module.net.parameters()])
            results.append((float(value.detach()), gradient.cpu().double()))
        (value, gradient), (other, on_gpu) = results
        assert other == pytest.approx(value, rel=1e-4)
        assert relative(on_gpu, gradient) < 1e-3

    def test_ten_optimiser_steps_end_near_those_of_the_cpu(self, surrogate, batch, exact_products):
        start = {name: tensor.clone() for name, tensor in surrogate.state_dict().items()}
        ends = []
        for device in ("cpu", "cuda"):
            surrogate.cpu().load_state_dict(start)
            surrogate.to(device).train()
            inputs = moved(batch, device)
            optimizer = torch.optim.SGD(surrogate.parameters(), lr=1e-3)
            for _ in range(10):
                optimizer.zero_grad()
                loss = surrogate.loss(surrogate.predict(inputs.load), inputs, surrogate.physics)
                loss.backward()
                optimizer.step()
            ends.append(float(loss.detach()))
        assert ends[1] == pytest.approx(ends[0], rel=1e-3)

    def test_gradients_pass_through_the_linear_solution(self, scene, batch):
        network = partial(FCNN, width=8)
        module = Surrogate.from_network(network, MSE(), scene, base="linear").to("cuda")
        force = batch.force.cuda().requires_grad_()
        load = Load(force, batch.young.cuda(), batch.parameters.cuda())
        module.predictor.base.solutions(load).sum().backward()
        ones = torch.where(scene.problem.free, 1.0, 0.0).double()
        expected = LinearSolver(scene.problem).solve(ones)
        assert relative(force.grad[0], expected) < 1e-4


RUNS = {
    "plain": ["experiment=paper", "model.width=16"],
    "fcnn": ["model=fcnn", "model.width=16"],
    "pod": ["model=pod"],
    "unrolled": ["model=unrolled"],
}


class TestTrainingOnGPUs:
    pytestmark = gpu

    @pytest.mark.parametrize("name", RUNS)
    def test_the_command_trains_on_a_gpu_and_evaluates(self, name, start, tiny_training, tmp_path):
        options = [one for one in tiny_training if not one.startswith("model.")]
        more = ["trainer=gpu", "trainer.max_epochs=2", "trainer.check_val_every_n_epoch=1"]
        process = start("train", *options, *RUNS[name], *more, "run=r", cwd=tmp_path)
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err[-3000:]
        (line,) = (tmp_path / "r/training.jsonl").read_text().splitlines()
        assert json.loads(line)["device"].startswith("cuda")
        rows = json.loads((tmp_path / "r/evaluation.json").read_text())
        assert any(row["solver"] == "prediction" for row in rows)

    def test_ddp_trains_on_all_visible_devices(self, start, tiny_training, tmp_path):
        count = torch.cuda.device_count()
        more = ["trainer=ddp", "trainer.accelerator=gpu", f"trainer.devices={count}"]
        last = ["trainer.max_epochs=2", "run=r"]
        process = start("train", *tiny_training, *more, *last, cwd=tmp_path)
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err[-3000:]
        assert (tmp_path / "r/evaluation.json").is_file()
        assert (tmp_path / "r/checkpoints/best.safetensors").is_file()
