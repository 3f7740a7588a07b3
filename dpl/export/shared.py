"""A data set, and a fitted run, as folders for people who have other tools or another machine."""

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dpl.evaluation.tables import PREDICTION, percent
from dpl.fem import write_mesh
from dpl.scene import Sample, Scene
from dpl.system.files import atomic_write
from dpl.version import __version__

PAIRS, BODY, CARD = "pairs.npz", "body.vtu", "README.md"


def write_pairs(scene: Scene, splits: Mapping[str, Sample], folder: Path) -> Path:
    """Write solved loads as arrays, with the body and a card; return the file of the arrays.

    The arrays have one row for each load: `force` and `displacement` (S, N, D), `young` (S,),
    `parameters` (S, P) and `split`, the number of the split among `splits`. `points` are the nodes
    (N, D). `data=files` reads the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    body = scene.problem
    parts = [
        {
            **{name: column.numpy() for name, column in scene.si_inputs(part.load).items()},
            "displacement": body.length * part.displacement.numpy(),
            "split": np.full(len(part.force), k),
        }
        for k, part in enumerate(splits.values())
    ]
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    with atomic_write(folder / PAIRS) as file:
        np.savez(file, points=body.points_in_metres, **arrays)  # type: ignore[arg-type]
    write_mesh(folder / BODY, body.mesh_in_metres, {})
    sizes = ", ".join(f"{len(part.force):,} {split}" for split, part in splits.items())
    rows = [
        ("loads", f"{sizes}; `split` numbers them from 0"),
        ("force", f"external nodal forces [{'N' if body.shape[1] == 3 else 'N/m'}]"),
        ("displacement", "solutions [m]"),
        ("young", "Young's modulus of each load [Pa]"),
        ("points", f"nodes [m], those of `{BODY}` and of its edges for quadratic cells"),
        ("parameters", ", ".join(scene.loads.parameter_ranges) or "none"),
        ("scene", f"fingerprint {scene.fingerprint}, dpl {__version__}"),
    ]
    _write_card(folder, "Loads of a hyperelastic body and their solutions", scene, rows)
    return folder / PAIRS


def write_published(
    scene: Scene,
    folder: Path,
    *,
    config: Mapping[str, Any],
    files: Iterable[Path],
    run: Path,
    license: str,
) -> Path:
    """Write what `dpl.load` needs of a run, with a card for a model hub; return the card.

    `config` is the configuration of the prediction, `files` are those of the scene in the folder
    `run`, `license` is the SPDX identifier. A folder that is not empty, and a run without weights
    in the format safetensors, are ValueErrors.
    """
    weights = run / "checkpoints" / "best.safetensors"
    if not weights.is_file():
        raise ValueError(f"{weights} is missing; only weights in the format safetensors are shared")
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder} must be empty; choose another folder")
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(dict(config), sort_keys=False))
    shutil.copy(weights, folder / "checkpoints")
    for path in [*files, evaluation := run / "evaluation.json", run / "shapes.png"]:
        if path.is_file():
            shutil.copy(path, folder)
    rows = []
    if evaluation.is_file():
        every = json.loads(evaluation.read_text())
        row = next(row for row in every if row["solver"] == PREDICTION)
        median, worst = (percent(row["errors"][f"rel_L2_{name}"]) for name in ("median", "worst"))
        shown = f"median {median} %, worst {worst} %, {row['loads']} test loads of the family above"
        rows.append(("relative L2 error of the prediction", shown))
    tags = ["finite-elements", "hyperelasticity", "surrogate"]
    head = {"license": license.lower(), "library_name": "deepphysics", "tags": tags}
    use = (
        f"```python\nimport dpl\n\nsim = dpl.load({folder.name!r})  # or 'hf://OWNER/NAME'\n"
        "answer = sim(force)  # nodal forces [N], (nodes, dimension)\n```\n"
    )
    picture = "\n![Shapes of test loads](shapes.png)\n" if (folder / "shapes.png").exists() else ""
    title = "Simulator of a hyperelastic body"
    return _write_card(folder, title, scene, rows, head=head, after=use + picture)


def _write_card(
    folder: Path,
    title: str,
    scene: Scene,
    rows: Iterable[tuple[str, str]],
    *,
    head: Mapping[str, Any] | None = None,
    after: str = "",
) -> Path:
    """Write a page that describes a folder; return its path."""
    front = f"---\n{yaml.safe_dump(dict(head))}---\n" if head else ""
    table = [f"| {name} | {text} |" for name, text in [*scene.describe(), *rows]]
    lines = [f"{front}# {title}\n", "| | |\n|---|---|", *table, "", after]
    with atomic_write(folder / CARD) as file:
        file.write("\n".join(lines).encode())
    return folder / CARD
