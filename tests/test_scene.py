"""Laws of the scene: its identity, its border to SI units, and a plan that says what is skipped."""

import json
from collections import defaultdict
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
import torch

from dpl.fem import Box, Newton, Plane, SaintVenantKirchhoff, Tag, box, rectangle, solve
from dpl.fem.identity import identity_of
from dpl.fem.loads import log_tail_mixture, logarithmic, normal, symmetric_uniform, uniform01


def mild(t, *, factor):
    return factor * symmetric_uniform(t)


@dataclass
class Pull:
    region: object
    size: float = 1


def test_an_identity_writes_regions_by_name_and_options():
    written = identity_of(Pull(Tag("tip")))
    region = {"class": "Tag", "name": "tip"}
    assert written == {"name": "Pull", "region": region, "size": 1.0}
    assert json.loads(json.dumps(written)) == written
    with pytest.raises(TypeError, match=r"Pull\.region is a object, which is no plain data"):
        identity_of(Pull(object()))


SAME = {  # what decides no sample
    "size and modulus": {"size": (1.0, 0.25, 0.25), "young": 2e11},
    "range of moduli": {"young": [1e9, 2e11]},
    "their distribution": {"young": {"low": 1e6, "high": 2e11, "distribution": "log"}},
    "size": {"size": (0.3, 0.075, 0.075)},
    "size with rounding": {"size": (1e3 / 3, 250 / 3, 250 / 3)},
    "backend": {"linear": "auto"},
    "way of Newton": {"newton": partial(Newton, factor_reuse_tol=0.0)},
    "steps of Newton": {"newton": partial(Newton, max_total_iter=9)},
}


@pytest.mark.parametrize("name", SAME)
def test_the_fingerprint_does_not_depend_on_what_decides_no_sample(make_scene, scene, name):
    assert make_scene(**SAME[name]).fingerprint == scene.fingerprint


def test_whole_numbers_and_floats_make_one_scene(make_scene):
    """As YAML writes them: deflection: 1, factor: 1, poisson: 0."""
    one = {"deflection": 1, "eigenvalue_exponent": 1, "poisson": 0}
    other = {"deflection": 1.0, "eigenvalue_exponent": 1.0, "poisson": 0.0}
    whole = make_scene(**one, distribution=partial(mild, factor=1))
    real = make_scene(**other, distribution=partial(mild, factor=1.0))
    assert whole.fingerprint == real.fingerprint
    assert whole.identity() == real.identity()


def test_an_identity_written_with_whole_numbers_is_that_of_the_scene(make_scene):
    scene = make_scene(deflection=1.0)
    written = json.loads(json.dumps(scene.identity()))
    written["loads"]["deflection"] = 1
    assert json.dumps(written) != json.dumps(scene.identity())
    assert scene.matches(written)
    assert scene.differences(written) == []
    written["loads"]["deflection"] = 2
    assert not scene.matches(written)
    assert scene.differences(written) == ["loads.deflection: 2 there, 1.0 here"]


def test_the_default_scene_has_the_identity_that_data_sets_on_disk_have(scene_of):
    """Data sets are found by it, in every process: a change makes all of them be solved anew."""
    assert scene_of().fingerprint.startswith("21aeaad6b7b1")


def reordered():
    mesh = box((100.0, 25.0, 25.0), (5, 3, 3))
    order = np.random.default_rng(0).permutation(mesh.p.shape[1])
    place = np.argsort(order)
    return type(mesh)(np.ascontiguousarray(mesh.p[:, order]), place[mesh.t])


CHANGES = {
    "poisson": {"poisson": 0.300001},
    "law": {"law": SaintVenantKirchhoff},
    "shape": {"size": (100.0, 25.0, 25.01)},
    "nodes": {"nodes": (6, 3, 3)},
    "order of the nodes": {"mesh": reordered()},
    "cells": {"cell": "tetra"},
    "degree": {"degree": 2},
    "clamped end": {"fixed": Plane(0, "max")},
    "clamped part": {"fixed": Box((0, 0, 0), (0, 25, 13))},
    "tolerance": {"tol": 1e-6},
    "modes": {"n_modes": 2},
    "selected modes": {"modes": [0, 1, 2]},
    "deflection": {"deflection": 0.41},
    "patch radius": {"patch_radius": (0.0, 0.5)},
    "distribution": {"distribution": normal},
    "argument of the distribution": {"distribution": partial(mild, factor=0.5)},
    "another argument": {"distribution": partial(mild, factor=0.6)},
    "eigenvalue exponent": {"eigenvalue_exponent": 1.0},
    "radius": {"radius": logarithmic},
    "argument of the radius": {"radius": partial(logarithmic, low=1e-4)},
    "amplitude": {"amplitude": log_tail_mixture},
    "argument of the amplitude": {"amplitude": partial(log_tail_mixture, part=0.5)},
    "amplitude as the radius": {"amplitude": uniform01},
    "sampling": {"sampling": "sobol"},
    "constant force": {"constant_force": torch.ones(45, 3, dtype=torch.float64)},
}


def test_the_fingerprint_depends_on_what_decides_a_sample(make_scene):
    """The names of scenes with equal fingerprints would be listed together."""
    scenes = {"none": {}, **CHANGES}
    names = defaultdict(list)
    for name, change in scenes.items():
        names[make_scene(**change).fingerprint].append(name)
    assert list(names.values()) == [[name] for name in scenes]


def test_the_identity_names_the_options_of_the_loads_and_no_other(scene):
    assert set(scene.identity()["loads"]) == {
        *("name", "n_modes", "deflection", "patch_radius", "distribution", "radius"),
        *("eigenvalue_exponent", "amplitude", "sampling", "constant_force"),
    }


def test_selected_modes_replace_their_number_in_the_identity(make_scene):
    one, other = (make_scene(modes=[0, 2], n_modes=n) for n in (3, 5))
    assert one.fingerprint == other.fingerprint != make_scene(modes=[0, 1]).fingerprint
    assert "n_modes" not in one.identity()["loads"]


def test_newtons_become_dimensionless_loads(scene):
    """A force of E L^2 is 1."""
    newtons = torch.full((2, *scene.problem.shape), 4500.0 * 100.0**2)
    load = scene.load_of(newtons, torch.tensor([4500.0, 9000.0]))
    assert load.force.dtype == load.young.dtype == torch.float64
    assert torch.allclose(load.force[0], torch.ones((), dtype=torch.float64), rtol=1e-12)
    assert torch.allclose(load.force[1], torch.full((), 0.5, dtype=torch.float64), rtol=1e-12)
    assert load.young.tolist() == [4500.0, 9000.0]


def test_forces_of_plane_bodies_are_per_thickness(make_scene):
    plane = make_scene(mesh=rectangle([8.0, 2.0], [5, 3]), n_modes=2)
    assert plane.force_unit == pytest.approx(8.0)
    load = plane.load_of(torch.full((1, *plane.problem.shape), 3.0 * 8.0), torch.tensor([3.0]))
    assert float(load.force[0, 0, 0]) == pytest.approx(1.0)


def test_displacements_in_metres_do_not_depend_on_who_made_them_dimensionless(make_scene):
    """The same body in other units: same newtons, same metres."""
    metres, millimetres = make_scene(), make_scene(size=(1e5, 25e3, 25e3), young=4500e-6)
    force = 0.02 * 4500.0 * 100.0**2 * metres.loads.sample((0, 0), [0]).force
    one = solve(metres.solver, metres.load_of(force, torch.tensor([4500.0])))
    other = solve(millimetres.solver, millimetres.load_of(force, torch.tensor([4500e-6])))
    ours, theirs = metres.length * one.displacement, millimetres.length * other.displacement
    assert torch.allclose(1e3 * ours, theirs, rtol=1e-6, atol=1e-9 * float(theirs.abs().max()))


def test_a_scene_has_one_factor_of_its_rest_stiffness(scene):
    assert scene.linear is scene.solver.linear_solver is scene.loads.linear
    assert scene.linear.factor is scene.linear.factor


def lines_with(scene, words):
    return [line for line in scene.skipped_work() if words in line]


def test_the_plan_names_one_modulus_or_the_range(make_scene, scene):
    assert lines_with(scene, "no E input")[0].endswith("(E = 4500 Pa)")
    ranged = make_scene(young=[1e9, 2e11])
    assert lines_with(ranged, "no E input")[0].endswith("(E from 1e+09 to 2e+11 Pa)")
    decades = make_scene(young={"low": 1e9, "high": 2e11, "distribution": "log"})
    assert lines_with(decades, "no E input")[0].endswith("2e+11 Pa, uniform in log E)")


def test_the_plan_says_where_more_modes_are_excited(make_scene, scene):
    assert not lines_with(scene, "a cluster of eigenvalues is kept whole")
    assert lines_with(
        make_scene(n_modes=1), "2 modes instead of 1: a cluster of eigenvalues is kept whole"
    )
