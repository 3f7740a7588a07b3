"""File of a fitted `unrolled` model for `dpl_runtime.hpp`, a C++ simulator without dependencies.

The file is in the format of safetensors: 8 bytes with the length of the header, the header in JSON
with type, shape and place of each array, and the arrays, little-endian, last axis fastest. Lengths
are over L and forces over E L^2, except for `points` [m]. docs/consumers.md lists the arrays.
"""

import math
import shutil
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save

from dpl.fem import (
    DemirayK2,
    InvariantBasedMaterial,
    ModalLoads,
    NeoHookeanIsoK4,
    NeoHookeanLn,
    Plane,
    Problem,
    SaintVenantKirchhoff,
    StableNeoHookean,
    Tag,
    YeohK2,
    surface,
)
from dpl.fem.assembly.kernels import constants_of
from dpl.fem.loads.forces import facet_areas
from dpl.fem.loads.sized import CombinedLoads, VectorLoads
from dpl.fem.materials.heterogeneous import one_law
from dpl.fem.mesh.regions import facets_in
from dpl.fem.postprocess import triangles
from dpl.models import Unrolled
from dpl.scene import Scene
from dpl.system.files import atomic_write
from dpl.training import TrainedSurrogate
from dpl.version import ROOT, __version__

FORMAT = "dpl runtime 3"
FILE, SOURCES = "runtime.safetensors", ("dpl_runtime.hpp", "dpl_c.h", "dpl_c.cpp")
# in a wheel inside the package, in a checkout in the documentation
HOME = next(filter(Path.is_dir, [ROOT / "dpl" / "consumers"]), ROOT / "docs" / "consumers")
LAWS = {  # names of the derivatives that the header has
    NeoHookeanLn.invariant_derivatives: "neo_hookean_ln",
    SaintVenantKirchhoff.invariant_derivatives: "hooke",
    StableNeoHookean.invariant_derivatives: "stable_neo_hookean",
    YeohK2.invariant_derivatives: "polynomial_k2",
    NeoHookeanIsoK4.invariant_derivatives: "polynomial_k4",
    DemirayK2.invariant_derivatives: "demiray_k2",
}
FAMILIES = {ModalLoads.project: "modal", CombinedLoads.project: "combined"}  # others: "other"

Arrays = dict[str, NDArray[Any]]


def write_runtime(folder: Path, surrogate: TrainedSurrogate) -> Path:
    """Write `runtime.safetensors` and copy the C++ sources that read it; return its path.

    The folder is created if it does not exist. A body that the header cannot simulate, or another
    model than a fitted `Unrolled`, is a ValueError.
    """
    net, scene = surrogate.net, surrogate.scene
    law = _checked_law(net, scene)
    fitted = cast(Unrolled, net)
    family = FAMILIES.get(type(scene.loads).project, "other")
    if family == "combined" and isinstance(scene.loads, VectorLoads):
        family = "vector"
    arrays = _model(fitted) | _body(scene, law) | _loads(scene) | _patches(scene.problem)
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}  # 1-D at least
    words = {
        "format": FORMAT,
        "dpl": __version__,
        "scene": scene.fingerprint,
        "law": LAWS[type(law).invariant_derivatives] + ("" if law.finite else "_small_strains"),
        "loads": family,
    }
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(path := folder / FILE) as file:
        file.write(with_checksum(arrays, words))
    for name in SOURCES:
        shutil.copyfile(HOME / name, folder / name)
    return path


def with_checksum(arrays: Arrays, words: dict[str, str]) -> bytes:
    """Return the content of a file: its CRC-32 with `crc32` = 00000000 is the value of `crc32`."""
    key, zero = b'"crc32":"%s"', b"0" * 8
    content = save(arrays, words | {"crc32": zero.decode()})
    return content.replace(key % zero, key % b"%08x" % zlib.crc32(content), 1)


def _checked_law(net: Any, scene: Scene) -> InvariantBasedMaterial:
    """Return the law of a body that the header can simulate."""
    problem, ranges = scene.problem, list(scene.loads.parameter_ranges)
    law = one_law(problem.material)
    known = getattr(type(law), "invariant_derivatives", None) in LAWS
    requirements = {
        "be three-dimensional; use outputs=[model]": problem.shape[1] == 3,
        f"have no ranges {ranges}; train a model with a number for each": not ranges,
        f"have one of the laws {', '.join(LAWS.values())}; use outputs=[model]": known,
        "have no mean dilatation; use outputs=[model]": problem.volume_functions is None,
        "have no elastic foundation; use outputs=[model]": problem.springs is None,
        "have no follower loads; use outputs=[model]": not problem.follower_loads,
        "be fitted with model=unrolled; use outputs=[model]": hasattr(net, "first_map")
        and net.is_fitted,
    }
    for words, is_met in requirements.items():
        if not is_met:
            raise ValueError(f"the run must {words}")
    return cast(InvariantBasedMaterial, law)


def _model(net: Unrolled) -> Arrays:
    """Return the arrays of `dpl.models.unrolled.loops`, of K(0)^-1 and of the estimated error."""
    (arrays, _), linear = net._arrays, net.linear
    orbits, own = arrays.orbits, arrays._asdict()
    del own["orbits"]
    law, inverse, _ = net._at(torch.zeros(1, 0))
    table, order, unknowns, _, values, block_factors = linear.blocks
    factors = np.append(linear.terms.factors(net.scene.problem.material)[0].numpy(), 1.0)
    return {
        **orbits._asdict(),
        "dofs": orbits.dofs.astype(np.int32),
        "supports": (factors @ linear.condensed.supports.numpy()).reshape(orbits.dofs.shape),
        **own,
        "columns": arrays.columns.astype(np.int32),
        "reduced_inverse": inverse,
        "law_samples": law[1],
        "front_table": table,
        "front_order": order.astype(np.int32),
        "front_unknowns": unknowns.astype(np.int32),
        "blocks": values,
        "block_factors": block_factors,
        "error_factor": np.array(net._doubt * math.exp(net.error_factors[0])),
        "error_exponents": net.error_exponents[0].numpy(),
        "least_sizes": net.least_sizes.numpy(),
    }


def _body(scene: Scene, law: InvariantBasedMaterial) -> Arrays:
    problem = scene.problem
    corners = problem.basis.nodal_dofs[0][triangles(surface(problem.mesh))]
    return {
        "length": np.array(scene.length),
        "force_unit": np.array(scene.force_unit),
        "young": np.array(scene.loads.moduli.middle),
        "points": problem.points_in_metres,
        "free": problem.free.numpy().astype(np.uint8),
        "prescribed": problem.prescribed.numpy(),
        "cells": problem.cells.numpy().astype(np.int32),
        "dN": problem.dN.numpy(),
        "dV": problem.dV.numpy(),
        "law_cells": constants_of(law)[0],
        "surface": problem.boundary.nonzero()[:, 0].numpy().astype(np.int32),
        "triangles": corners.astype(np.int32),
    }


def _loads(scene: Scene) -> Arrays:
    loads, problem = scene.loads, scene.problem
    constant = loads.constant_force
    found: Arrays = {
        "largest_force": np.array(loads.largest_force),
        "constant_force": np.zeros(problem.shape) if constant is None else constant.numpy(),
        "loadable": loads.loadable_dofs.numpy().astype(np.uint8),
    }
    if type(loads).project not in FAMILIES:
        return found
    if isinstance(loads, ModalLoads):
        shapes, span = loads.modal_forces.numpy(), (*loads._span, *loads._span, 1.0)
    elif isinstance(loads, CombinedLoads):
        shapes = loads._acting_shapes.reshape(*problem.shape, -1)
        span = (*loads.coefficient_range, *loads.sizes, loads.largest_size)
    nodes = np.flatnonzero((shapes != 0).any(axis=(1, 2)))
    known = {"load_nodes": nodes.astype(np.int32), "load_shapes": shapes[nodes]}
    return found | known | {"load_span": np.array(span)}


def _patches(problem: Problem) -> Arrays:
    """Return nodes and weights of a uniform traction on each side and boundary group of a body."""
    mesh = problem.mesh
    regions: dict[str, Any] = {}
    for axis, name in enumerate("xyz"):
        regions |= {f"{name}_{end}": Plane(axis, end) for end in ("min", "max")}
    groups = [name for name in mesh.boundaries or {} if name.isprintable()]
    regions |= {name: Tag(name) for name in groups if not set(name) & set('"\\')}
    found: Arrays = {}
    for name, region in regions.items():
        with suppress(ValueError):  # a side without facets
            facets = facets_in(region, mesh, problem.length, problem.origin)
            areas = facet_areas(problem, facets) @ np.ones(len(facets))
            nodes = np.flatnonzero(areas)
            found[f"patch.{name}.nodes"] = nodes.astype(np.int32)
            found[f"patch.{name}.weights"] = areas[nodes] / areas.sum()
    return found
