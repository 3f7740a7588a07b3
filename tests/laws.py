"""The laws of `conf/material`: a new file there is tested like all others."""

from pathlib import Path

from hydra.utils import instantiate
from omegaconf import OmegaConf

from dpl.fem import FibreReinforced, InvariantBasedMaterial, Material, YoungPoissonMaterial

FILES = sorted((Path(__file__).parents[1] / "conf" / "material").glob("*.yaml"))
LAWS: dict[str, Material] = {
    path.stem: instantiate(OmegaConf.load(path), _convert_="all") for path in FILES
}
HOOKEAN = [type(law) for law in LAWS.values() if isinstance(law, YoungPoissonMaterial)]
COMPILED = [name for name, law in LAWS.items() if isinstance(law, InvariantBasedMaterial)]
ISOTROPIC = [name for name, law in LAWS.items() if not isinstance(law, FibreReinforced)]
