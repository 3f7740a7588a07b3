"""conf/ is the only registry: everything in it instantiates, composes and solves."""

import importlib.util
import itertools
import re
from pathlib import Path

import hydra
import meshio
import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from skfem.io.meshio import to_meshio

from dpl.config import ConfigError, build, plain
from dpl.data.solving.solve import LoadKey, solve_load
from dpl.fem import ParameterRange, box, solve

CONF = Path(__file__).parents[2] / "conf"


def options(group):
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


MESHES = [
    pytest.param(name, marks=pytest.mark.slow) if name == "paper_beam" else name
    for name in options("mesh")
]
WHOLE = ("experiment", "debug", "hparams_search")  # groups that set keys of others
NAMED = ("callbacks", "logger")  # groups whose options are calls by name
GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name not in WHOLE)


@pytest.fixture
def part(tmp_path, in_process):
    """A mesh file that this package did not write."""
    mesh = box([2.0, 0.5, 0.5], [7, 3, 3], "tetra")
    path = tmp_path / "part.vtk"
    meshio.write(path, meshio.Mesh(mesh.p.T, [("tetra", mesh.t.T)]))
    return path


@pytest.fixture
def forces(tmp_path):
    """A file of two forces on the beam of 5 x 3 x 3 nodes."""
    path = tmp_path / "forces.npy"
    np.save(path, np.random.default_rng(0).normal(size=(2, 45, 3)))
    return path


@pytest.fixture
def overrides(part, forces):
    """What an option of a group needs besides its name."""

    def overrides(group, name):
        needed = {
            "mesh=file": [f"mesh.path={part}"],
            "fixed=tag": ["fixed.name=bore"],
            "fixed=cylinder": ["fixed.radius=0.05"],
            "loads=cable": ["loads.cables=[[[5,5,5],[50,10,5],[95,5,5]],[[5,20,20],[95,20,20]]]"],
            "loads=file": [f"loads.path={forces}"],
            "data=files": [f"data.path={forces}"],
            "loads=pressure": ["loads.region={_target_:dpl.fem.Plane,axis:2,at:max}"],
            "loads=traction": ["loads.region={_target_:dpl.fem.Plane,axis:0,at:max}"],
        }
        option = f"{group}={name}"
        return [option, *needed.get(option, [])]

    return overrides


@pytest.mark.parametrize("name", MESHES)
def test_a_mesh_clamps_something_and_newton_answers_three_loads(scene_of, overrides, name):
    scene = scene_of(*overrides("mesh", name), "solver.linear=superlu")
    free = scene.problem.free
    assert 0 < int((~free).sum()) < free.numel()
    assert scene.problem.unconstrained_rigid_body_modes() == []
    answer = solve(scene.solver, scene.loads.sample((0, 0), range(3)))
    assert answer.converged.all()
    assert (answer.volume_ratio > 0).all()


SMALL = {
    "beam": ["mesh=beam", "mesh.nodes=[5,3,3]"],
    "tetra": ["mesh=beam", "mesh.nodes=[5,3,3]", "+mesh.cell=tetra"],
    "quadratic": ["mesh=beam", "mesh.nodes=[3,2,2]", "degree=2"],
    "rectangle": ["mesh=rectangle", "mesh.nodes=[9,3]"],
    "triangle": ["mesh=rectangle", "mesh.nodes=[9,3]", "+mesh.cell=triangle"],
}


@pytest.mark.parametrize(
    ("material", "mesh"),
    [*zip(sorted({*options("material")} - {"unknown"}), itertools.cycle(SMALL), strict=False)],
)
def test_every_law_answers_loads_and_every_kind_of_mesh_has_several_laws(scene_of, material, mesh):
    plane = mesh in ("rectangle", "triangle")
    half = "[0,0],upper:[50,25]" if plane else "[0,0,0],upper:[50,25,25]"
    region = f"+regions.core={{_target_:dpl.fem.Box,lower:{half}}}"
    parts = [region] if material == "regions" else []
    scene = scene_of(*SMALL[mesh], f"material={material}", *parts, "solver.linear=superlu")
    one = solve_load(scene, LoadKey((0, 0), 0))
    assert one.accepted
    assert one.displacement.any()


@pytest.mark.parametrize("name", options("loads"))
def test_every_load_family_draws_loads_that_newton_answers(scene_of, overrides, name):
    units = ["loads.factor=null"] if name == "file" else []
    scene = scene_of(*SMALL["beam"], *overrides("loads", name), *units, "solver.linear=superlu")
    load = scene.loads.sample((0, 0), range(3))
    assert solve(scene.solver, load).converged.all()
    amplitude, distance = scene.loads.project(load.force)
    assert (amplitude <= 1 + 1e-9).all()
    assert (distance < 1e-9).all()


@pytest.mark.parametrize(
    ("group", "name"), [(group, n) for group in ("experiment", "debug") for n in options(group)]
)
def test_an_experiment_composes_and_passes_the_check(compose, group, name):
    cfg = compose(f"{group}={name}", "folder=.", command="train")
    plain.check(cfg)
    assert_holds(cfg, group, name)
    if group == "debug":
        assert cfg.tags == ["debug"]
        assert cfg.trainer.accelerator == "cpu"
        assert list(cfg.callbacks) == ["best_weights", "last_checkpoint"]
        assert cfg.trainer.max_epochs <= 50


@pytest.mark.parametrize("experiment", [None, "beam_svk"])
@pytest.mark.parametrize("name", options("hparams_search"))
def test_a_sweep_composes_passes_the_check_and_searches_among_what_there_is(
    compose, name, experiment
):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    choices = [f"hparams_search={name}", f"experiment={experiment or 'null'}", "folder=."]
    plain.check(compose(*choices, command="train"))
    search = OmegaConf.load(CONF / "hparams_search" / f"{name}.yaml").hydra.sweeper.params
    spaces = OverridesParser.create().parse_overrides(
        [f"{k}={space}" for k, space in search.items()]
    )
    for end in (0, -1):
        values = {}
        for one in spaces:
            space = one.value()
            among = space.list if one.is_choice_sweep() else (space.start, space.end)
            values[one.key_or_group] = among[end]
        cfg = compose(*choices, *(f"{k}={v}" for k, v in values.items()), command="train")
        assert {key: OmegaConf.select(cfg, key) for key in values} == values
        plain.check(cfg)


@pytest.fixture(scope="module")
def usual():
    """The training that the command line does not change."""
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = hydra.compose("train", overrides=["folder=.", "run=x"])
    GlobalHydra.instance().clear()
    return cfg


@pytest.mark.parametrize(
    ("group", "name"), [(group, name) for group in GROUPS for name in options(group)]
)
def test_an_option_changes_only_its_group_and_passes_the_check(
    compose, usual, overrides, group, name
):
    """A law in Pa decides `young`; a model may bring the batch size and epochs that suit it."""
    cfg = compose(*overrides(group, name), "folder=.", "run=x", command="train")
    plain.check(cfg)
    assert_holds(cfg, group, name)
    more = {"material": {"young"}, "model": {"data", "trainer"}}.get(group, set())
    more |= {"loads"} if (group, name) == ("data", "files") else set()  # the forces of the file
    assert {key for key in cfg if cfg[key] != usual[key]} <= {group, *more}


def test_a_value_that_another_key_needs_is_asked_for_by_its_name(compose):
    with pytest.raises(ConfigError, match=r"^data\.path is missing; set it on the command line$"):
        plain.check(compose("data=files", "folder=.", "run=x", command="train"))


def assert_holds(cfg, group, name):
    """The values of an option's file are those of the configuration."""
    path = CONF / group / f"{name}.yaml"
    option = OmegaConf.load(path)
    option.pop("defaults", None)
    whole = path.read_text().startswith("# @package _global_")
    assert OmegaConf.merge(cfg, option if whole else {group: option}) == cfg


def test_commands_share_the_scene_and_the_sizes_of_the_data_set(compose, usual):
    """A data set from generate.py is the one that train.py looks for."""
    cfg = compose()
    for key in ("fixed", "degree", "young", "solver", "mesh", "material", "loads"):
        assert cfg[key] == usual[key], key
    for key in ("folder", "seed", "train", "val", "test"):
        assert cfg.data[key] == usual.data[key], key


def test_callbacks_and_loggers_are_changed_added_and_removed_by_name(compose):
    changes = [
        "callbacks.worst_cases.meshes=false",
        "~callbacks.throughput",
        "+callbacks.stop={_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: a}",
        "logger=csv",
        "+logger.more=${logger.csv}",
        "trainer.accelerator=cpu",
    ]
    cfg = compose("folder=.", *changes, command="train")
    plain.check(cfg)
    trainer = build.build_trainer(cfg)
    names = [type(callback).__name__ for callback in trainer.callbacks]
    assert "EarlyStopping" in names
    assert "ThroughputMonitor" not in names
    (plots,) = (one for one in trainer.callbacks if type(one).__name__ == "WorstCasePlots")
    assert plots.meshes is False
    assert [type(logger).__name__ for logger in trainer.loggers] == ["CSVLogger"] * 2


@pytest.mark.parametrize("name", ["mlflow", "wandb"])
def test_a_logger_whose_package_is_missing_names_its_installation(compose, name):
    if importlib.util.find_spec(name):
        pytest.skip(f"{name} is installed")
    cfg = compose("folder=.", f"logger={name}", "trainer.accelerator=cpu", command="train")
    with pytest.raises(ConfigError, match=rf"logger\.{name}: .*pip install -U '{name}"):
        build.build_trainer(cfg)


def test_the_command_line_wins_over_an_experiment(compose):
    """In any order on the command line, by name of the option and by number."""
    for choice in (["experiment=paper", "loss=rmse"], ["loss=rmse", "experiment=paper"]):
        cfg = compose(*choice, "folder=.", command="train")
        assert cfg.loss._target_.endswith("RMSELoss")
        assert cfg.optimizer._target_.endswith("AdamW")
    numbers = ["optimizer.lr=1e-2", "data.batch_size=8", "model=pod", "model.base=linear"]
    cfg = compose(*numbers, "experiment=paper", "folder=.", command="train")
    assert (cfg.optimizer.lr, cfg.data.batch_size, cfg.model.base) == (1e-2, 8, "linear")
    plain.check(cfg)


@pytest.mark.parametrize("name", options("model"))
def test_every_model_has_the_linear_solution_unless_the_paper_is_asked_for(compose, name):
    cfg = compose(f"model={name}", "folder=.", command="train")
    assert cfg.model.get("base") == ("linear" if name not in ("unrolled", "fcnn_paper") else None)
    assert cfg.optimizer._target_.endswith("Muon")


def test_experiments_are_combined(compose):
    experiment = compose("experiment=beam_nh_loss", "folder=.", command="train")
    cfg = compose("experiment=[beam_nh_loss,paper]", "model=pod", "folder=.", command="train")
    plain.check(cfg)
    assert cfg.mesh == experiment.mesh
    assert cfg.data.train == experiment.data.train == 4095
    assert cfg.loss._target_.endswith("LrStar")
    assert cfg.optimizer._target_.endswith("AdamW")
    assert (cfg.model.base, cfg.data.batch_size, cfg.data.symmetry) == (None, 64, False)


def test_small_loads_are_small_in_force_and_in_area(scene_of):
    scene = scene_of("loads=modal_small", *SMALL["beam"], "solver.linear=superlu")
    loads = scene.loads
    assert loads.sampling == "sobol"
    drawn = loads.sample((0, 0), range(64))
    size = drawn.force.flatten(1).norm(dim=1) / loads.largest_force
    assert 0 < float(size.min()) < 1e-3
    assert int((drawn.force.any(dim=2).sum(dim=1) == 1).sum()) > 20
    for number in range(3):
        assert solve_load(scene, LoadKey((0, 0), number)).accepted


def test_the_beam_of_a_range_of_moduli_shares_its_data_with_the_beam_of_one(scene_of):
    """The same body in units of L and E, whatever its size and modulus."""
    beam, young = (scene_of(f"experiment={name}") for name in ("beam_nh_loss", "beam_young"))
    assert young.fingerprint == beam.fingerprint
    assert young.loads.moduli == (1e9, 2.03e11)
    assert beam.loads.moduli[0] == beam.loads.moduli[1]
    assert (young.length, beam.length) == pytest.approx((1.0, 100.0))
    assert beam.fingerprint.startswith("21aeaad6b7b1"), "data sets of the paper's beam are valid"


def test_the_distribution_of_the_moduli_is_one_key_of_the_experiments(scene_of):
    usual, wide = ["mesh.nodes=[5,3,3]"], "experiment=beam_young_wide"
    for name in ("uniform", "log"):
        moduli = scene_of(wide, f"young.distribution={name}", *usual).loads.moduli
        assert moduli == ParameterRange(1e6, 2.03e11, is_log=name == "log")
    assert scene_of(wide, "young=4500", *usual).loads.moduli == (4500.0, 4500.0)


@pytest.mark.parametrize(
    "fixed", [["fixed=tag", "fixed.name=bore"], ["fixed=cylinder", "fixed.radius=0.05"]]
)
def test_propeller_is_held_at_its_bore_by_name_or_by_place(scene_of, fixed):
    scene = scene_of("mesh=propeller", *fixed)
    assert int((~scene.problem.free).all(dim=1).sum()) == 175


@pytest.fixture
def named_part(tmp_path, in_process) -> list[str]:
    """Overrides for a bar of 4 x 1 x 2 mm with named faces and cells, in a file in millimetres."""
    mesh = box([4.0, 1.0, 2.0], [5, 2, 3])
    flat = to_meshio(mesh)
    ends = {"foot": mesh.p[0] == 0, "top": mesh.p[0] == 4}
    file = meshio.Mesh(
        flat.points,
        flat.cells,
        point_sets={name: np.flatnonzero(inside) for name, inside in ends.items()},
        cell_sets={"half": [np.flatnonzero(mesh.p[0, mesh.t].max(axis=0) <= 2)]},
    )
    meshio.write(tmp_path / "part.inp", file)
    return ["mesh=file", f"mesh.path={tmp_path / 'part.inp'}", "mesh.scale=1e-3", "fixed=tag"]


PARTS = (
    "loads=traction loads.region=%top% "
    "+supports.slide={_target_:dpl.fem.DirichletBC,region:%top%,value:[null,0,null]} "
    "+forces.p={_target_:dpl.fem.Traction,region:%top%,value:[1,0,0]} "
    "material=regions +regions.core=%half%"
)


LID = "'lid' must be a group of the mesh: 'foot', 'half', 'top'$"


def test_a_string_is_a_group_of_the_mesh_wherever_a_region_is_expected(compose, named_part):
    scenes = []
    for form in (r"\1", r"{_target_:dpl.fem.Tag,name:\1}"):
        lines = re.sub("%(.*?)%", form, PARTS).split()
        cfg = compose(*named_part, "fixed.name=foot", *lines)
        if form == r"\1":
            cfg.fixed = "foot"
        plain.check(cfg)
        scenes.append(build.build_scene(cfg))
    assert scenes[0].length == pytest.approx(4e-3)
    assert scenes[0].fingerprint == scenes[1].fingerprint


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("fixed.name=lid", f"fixed: .*{LID}"),
        ("loads=traction loads.region=lid", f"loads: .*{LID}"),
        ("+forces.p={_target_:dpl.fem.Traction,region:lid,value:[1,0,0]}", rf"forces\.p: .*{LID}"),
        ("+supports.s={_target_:dpl.fem.DirichletBC,region:lid}", f"fixed or supports: .*{LID}"),
        ("material=regions +regions.core=lid", rf"material\.core: .*{LID}"),
        ("mesh.scale=0.0", r"mesh: scale = 0.0 must be a number above 0"),
    ],
)
def test_an_unknown_group_is_one_line_that_lists_the_groups(scene_of, named_part, change, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        scene_of(*named_part, "fixed.name=foot", *change.split())


def test_moduli_in_pascal_decide_youngs_modulus(scene_of):
    """Mooney-Rivlin with 2 (c10 + c01) = 0.4225 MPa, of Treloar's rubber: E = 2 mu (1 + nu)."""
    small = [*SMALL["beam"], "material=mooney_rivlin_k2", "material.poisson=0.45"]
    scene = scene_of(*small)
    assert scene.loads.moduli[0] == pytest.approx(2 * 0.4225e6 * 1.45, rel=1e-4)
    assert scene.problem.material.mu * 2.9 == pytest.approx(1)
    described = "E = 1.225e+06 Pa, mu = 4.225e+05 Pa, K = 4.084e+06 Pa, nu = 0.45"
    assert described in dict(scene.describe())["law"]
    bulk = scene_of(*small[:-1], "material.poisson=null", "material.bulk=4.0842e6")
    assert bulk.loads.moduli[0] == pytest.approx(scene.loads.moduli[0], rel=1e-4)
    kilo = ["material.c10=184.84", "material.c01=26.41", "young=1e6"]
    relative = scene_of(*small, *kilo)
    assert relative.loads.moduli == (1e6, 1e6)
    assert relative.problem.material.mu == pytest.approx(float(scene.problem.material.mu))


def test_the_range_of_a_modulus_is_in_pascal(scene_of):
    scene = scene_of(*SMALL["beam"], "material=yeoh_k2", "material.c10=[0.1e6,0.3e6]")
    assert scene.problem.parameter_ranges == {"c10": (0.1e6, 0.3e6)}
    assert scene.problem.material.units_of_ranges == {"c10": 1 / scene.loads.moduli[0]}
    assert scene.loads.moduli[0] == pytest.approx(2 * 0.4e6 * 1.4)
    soft, stiff = (scene.problem.with_parameters(torch.tensor([[c]])) for c in (0.1e6, 0.3e6))
    assert float(stiff.material.mu / soft.material.mu) == pytest.approx(3)


def test_families_of_a_mixture_are_added_changed_and_removed_by_name(scene_of):
    changes = [
        "+loads@loads.families.weight=gravity",
        "loads.families.weight.deflection=0.1",
        "loads.families.patch.patch_radius=[0.1,0.2]",
        "~loads.families.modal",
        "loads.weights={weight:3}",
    ]
    loads = scene_of(*SMALL["beam"], "loads=mixture", *changes, "solver.linear=superlu").loads
    assert tuple(loads.families) == ("patch", "point", "gravity", "weight")
    assert loads.members[0].patch_radius == [0.1, 0.2]
    assert loads.members[3].deflection == 0.1
    assert loads.sample(0, range(2)).force.any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ("loads=traction", "loads.region is missing"),
        ("loads=point young=[1e3,1e4] loads.largest=3", "loads: largest = 3 must be divided"),
        ("loads=patch loads.region={_target_:dpl.fem.Plane,axis:0,at:7}", "loads: region = Plane"),
        ("loads=file loads.path=none.npy", "loads: path = none.npy: No such file"),
        ("loads=mixture loads.families.patch.largest=-1", "loads: families.patch: largest = -1"),
        ("loads=mixture +loads.families.patch.size=1", "loads.families.patch.size: dpl.fem.Patch"),
    ],
)
def test_invalid_loads_are_refused_in_one_line_that_names_the_key(scene_of, changes, message):
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}") as caught:
        scene_of(*SMALL["beam"], *changes.split(), "solver.linear=superlu")
    assert "\n" not in str(caught.value)
