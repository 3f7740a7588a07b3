"""The laws of `conf/material`: a new file there is tested like all others."""

from pathlib import Path

from hydra.utils import instantiate
from omegaconf import OmegaConf

from dpl.fem import FibreReinforced, InvariantBasedMaterial, Material, YoungPoissonMaterial

FILES = sorted((Path(__file__).parents[1] / "conf" / "material").glob("*.yaml"))
LOADED = {path.stem: OmegaConf.load(path) for path in FILES}
NODES = {name: node.get("material", node) for name, node in LOADED.items()}
LAWS: dict[str, Material] = {  # not those of several regions; Young's modulus at rest is 1
    name: law.normalised()
    for name, node in NODES.items()
    if "_target_" in node and (law := instantiate(node, _convert_="all")).is_known
}
HOOKEAN = [type(law) for law in LAWS.values() if isinstance(law, YoungPoissonMaterial)]
COMPILED = [name for name, law in LAWS.items() if isinstance(law, InvariantBasedMaterial)]
ISOTROPIC = [name for name, law in LAWS.items() if not isinstance(law, FibreReinforced)]
